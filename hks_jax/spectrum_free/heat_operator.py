"""A grid's pencil as what polynomials in M⁻¹K need: K, M, and M⁻¹ as a fixed polynomial."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hks_jax.fem.columns import stencil, stencil_outer
from hks_jax.fem.operators import StencilOperator
from hks_jax.fem.pencil import Pencil
from hks_jax.fem.space import GridSpace
from hks_jax.linear.chebyshev import chebyshev_iteration
from hks_jax.linear.operators import DiagonalOperator


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

    def products(self) -> "HeatProducts":
        """Return the products: to be called outside the loop that they are for."""
        return HeatProducts(self)


class HeatProducts:
    """What polynomials are made of: K, M, P and PK times nodal columns, their stencils made ready once."""

    def __init__(self, operator: HeatOperator) -> None:
        self.operator = operator
        self.periodic = operator.space.periodic
        self.apply_stiffness = stencil(operator.stiffness, self.periodic)
        self.apply_mass = self._mass(operator.mass)

    def _mass(self, mass: Array) -> Callable[[Array], Array]:
        return (lambda x: mass[..., None] * x) if self.operator.lumped else stencil(mass, self.periodic)

    def solve_mass(self, r: Float[Array, "*shape b"]) -> Float[Array, "*shape b"]:
        """Return Pr."""
        scaled, low = self.operator.inverse_row_sums[..., None], self.operator.low
        if self.operator.lumped:
            return scaled * r

        def product(x: Array) -> Array:
            return scaled * self.apply_mass(x)

        one = jnp.ones((), r.dtype)
        return -chebyshev_iteration(product, scaled * r, low, one, 0.0, self.operator.mass_degree)

    def apply(self, x: Float[Array, "*shape b"]) -> Float[Array, "*shape b"]:
        """Return PKx ≈ M⁻¹Kx."""
        return self.solve_mass(self.apply_stiffness(x))

    def changed_by(self, d_stiffness: Array, d_mass: Array) -> Callable[[Array, Array], Array]:
        """Return (x, y) ↦ dK x − dM y: with y = M⁻¹Kx, M⁻¹ times it is the change of y."""
        stiffness, mass = stencil(d_stiffness, self.periodic), self._mass(d_mass)
        return lambda x, y: stiffness(x) - mass(y)

    def outer_mass(self, p: Array, x: Array) -> Array:
        """Return the derivative of Σ_b pᵀMx by the entries of M."""
        return jnp.sum(p * x, axis=-1) if self.operator.lumped else stencil_outer(p, x, self.periodic)


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
