"""A grid's pencil as what polynomials in M⁻¹K need: K, M, and M⁻¹ as a fixed polynomial."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hks_jax.fem.columns import stencil_outer, stencil_product
from hks_jax.fem.operators import DiagonalOperator, StencilOperator
from hks_jax.fem.pencil import Pencil
from hks_jax.fem.space import GridSpace


class HeatOperator(eqx.Module):
    """K and M of one pencil on nodal arrays, zero at nodes that are not free, and P ≈ M⁻¹.

    A lumped mass is inverted exactly. For a consistent one, P r is what ``mass_degree`` steps of Chebyshev iteration
    with D⁻¹M make of r, D the row sums of M: a polynomial in D⁻¹M with fixed coefficients, so that P is linear and
    symmetric, and |1 − μ p(μ)| ≤ 1/T_m(σ) on the spectrum [low, 1] of D⁻¹M, σ = (1 + low)/(1 − low). (Its upper end
    is 1 by Gershgorin's theorem, as the entries of M are not negative.)

    Attributes:
        stiffness: (3^d, *shape).
        mass: (3^d, *shape) or, lumped, (*shape).
        inverse_row_sums: (*shape), D⁻¹; 0 at nodes that are not free.
        low: the lower end of the spectrum of D⁻¹M; 1 if lumped.
        mass_degree: steps; 1 if lumped.
    """

    stiffness: Float[Array, "offsets *shape"]
    mass: Float[Array, "..."]
    inverse_row_sums: Float[Array, "*shape"]
    low: Float[Array, ""]
    space: GridSpace = eqx.field(static=True)
    mass_degree: int = eqx.field(static=True)

    @property
    def lumped(self) -> bool:
        """Whether the mass is diagonal."""
        return self.mass.ndim == self.space.dimension

    def apply_stiffness(self, x: Float[Array, "*shape b"]) -> Float[Array, "*shape b"]:
        """Return Kx."""
        return stencil_product(self.stiffness, x, self.space.periodic)

    def apply_mass(self, x: Float[Array, "*shape b"]) -> Float[Array, "*shape b"]:
        """Return Mx."""
        return self._multiply(self.mass, x)

    def _multiply(self, mass: Array, x: Array) -> Array:
        return mass[..., None] * x if self.lumped else stencil_product(mass, x, self.space.periodic)

    def solve_mass(self, r: Float[Array, "*shape b"]) -> Float[Array, "*shape b"]:
        """Return Pr."""
        scaled = self.inverse_row_sums[..., None]
        if self.lumped:
            return scaled * r
        middle, half = (1 + self.low) / 2, (1 - self.low) / 2

        def step(_: int, state: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
            x, r, update, ratio = state
            r = r - self.apply_mass(update)
            following = 1 / (2 * middle / half - ratio)
            update = following * (ratio * update + (2 / half) * scaled * r)
            return x + update, r, update, following

        first = scaled * r / middle
        return jax.lax.fori_loop(1, self.mass_degree, step, (first, r, first, half / middle))[0]

    def apply(self, x: Float[Array, "*shape b"]) -> Float[Array, "*shape b"]:
        """Return PKx ≈ M⁻¹Kx."""
        return self.solve_mass(self.apply_stiffness(x))

    def moved(self, d_stiffness: Array, d_mass: Array, x: Array, image: Array) -> Array:
        """Return dK x − dM y: with y = M⁻¹Kx, M⁻¹ times it is the change of y."""
        return stencil_product(d_stiffness, x, self.space.periodic) - self._multiply(d_mass, image)

    def outer_mass(self, p: Array, x: Array) -> Array:
        """Return the derivative of Σ_b pᵀMx by the entries of M."""
        return jnp.sum(p * x, axis=-1) if self.lumped else stencil_outer(p, x, self.space.periodic)


def heat_operator(pencil: Pencil, low: Float[Array, ""] | float = 1.0, mass_degree: int = 1) -> HeatOperator:
    """Return the operator of a pencil on a grid."""
    space, stiffness = pencil.space, pencil.stiffness
    assert isinstance(space, GridSpace)
    assert isinstance(stiffness, StencilOperator)
    if isinstance(pencil.mass, DiagonalOperator):
        mass = sums = space.extend(pencil.mass.entries, outside=0.0)
    else:
        assert isinstance(pencil.mass, StencilOperator)
        mass, sums = pencil.mass.coefficients, jnp.sum(pencil.mass.coefficients, axis=0)
    # A constant: P stands for M⁻¹, and is differentiated as that.
    inverse = jax.lax.stop_gradient(jnp.where(space.free, 1 / jnp.where(space.free, sums, 1), 0))
    return HeatOperator(stiffness.coefficients, mass, inverse, jnp.asarray(low, mass.dtype), space, mass_degree)
