"""The matrices of a grid as stencils on nodal arrays, with masks as arrays, so that all masks share compiled code."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.sharding import Mesh
from jaxtyping import Array, Bool, Float

from hks_jax.fem.halo import Slabs
from hks_jax.fem.pencil import Pencil
from hks_jax.fem.space import GridSpace, mask_for
from hks_jax.fem.stencil import Stencil, coefficients_of
from hks_jax.linear.chebyshev import chebyshev_iteration


class NodalPencil(eqx.Module):
    """The matrices K and M on all nodes of a grid, with masks as arrays."""

    stiffness: Stencil  # K
    mass: Stencil  # M; a diagonal if lumped
    lumped: Float[Array, "*shape"]  # the row sums D of M as constants; 1 at nodes that are not free
    free: Bool[Array, "*shape"]  # the nodes that carry a degree of freedom
    domain: Bool[Array, "*shape"]  # the nodes of the domain: free nodes, and nodes where functions vanish

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of nodal arrays."""
        return self.lumped.shape

    @property
    def periodic(self) -> tuple[bool, ...]:
        """Whether each axis is periodic."""
        return self.stiffness.periodic

    @property
    def lumped_or_zero(self) -> Float[Array, "*shape"]:
        """The row sums D, but 0 at nodes that are not free."""
        return jnp.where(self.free, self.lumped, 0)

    def cut(self, mesh: Mesh | None) -> Slabs | None:
        """Return the division of the grid into slabs for the devices of a mesh; None for a single device."""
        return None if mesh is None else Slabs(mesh, self.shape, self.periodic)

    def own(self, slabs: Slabs | None) -> "NodalPencil":
        """Return this device's slab, inside `shard_map`."""
        if slabs is None:
            return self
        masks = (slabs.own(x) for x in (self.lumped, self.free, self.domain))
        return NodalPencil(self.stiffness.own(slabs), self.mass.own(slabs), *masks)

    def products(self) -> Callable[[Float[Array, "*shape b"]], tuple[Float[Array, "*shape b"], ...]]:
        """Return the function x ↦ (Kx, Mx), which reads neighbours once for both products; call it outside loops."""
        stiffness, mass = self.stiffness.of_rimmed(), self.mass.of_rimmed()

        def both(x: Float[Array, "*shape b"]) -> tuple[Float[Array, "*shape b"], ...]:
            rimmed = self.stiffness.rimmed(x)
            return stiffness(x, rimmed), mass(x, rimmed)

        return both

    # Chebyshev iteration with m steps solves D⁻¹Mx = D⁻¹r approximately. The result is x = Pr with P = p(D⁻¹M)D⁻¹ and a
    # fixed polynomial p of degree m − 1, so P is linear and symmetric. For an eigenvalue μ of D⁻¹M in [low, 1],
    # |1 − μ p(μ)| ≤ 1/T_m(σ), where T_m is a Chebyshev polynomial and σ = (1 + low)/(1 − low). The eigenvalues of D⁻¹M
    # are at most 1 by Gershgorin's theorem, since the entries of M are not negative. For ζ = 0, `chebyshev_iteration`
    # returns −p(D⁻¹M)D⁻¹r, hence the minus sign in the code.
    def mass_solve(
        self, low: Float[Array, ""] | float, degree: int
    ) -> Callable[[Float[Array, "*shape b"]], Float[Array, "*shape b"]]:
        """Return r ↦ Pr, where P is M⁻¹ for a lumped M, or else approximates M⁻¹ by ``degree`` Chebyshev steps."""
        inverse, mass = 1 / self.lumped[..., None], self.mass.of_columns()
        if self.mass.is_diagonal:
            return lambda r: inverse * r
        ends = jnp.asarray(low, inverse.dtype), jnp.ones((), inverse.dtype)
        return lambda r: -chebyshev_iteration(lambda x: inverse * mass(x), inverse * r, *ends, 0.0, degree)


def lump(stiffness: Stencil, mass: Stencil, free: Bool[Array, "*shape"], domain: Bool[Array, "*shape"]) -> NodalPencil:
    """Return the `NodalPencil` of a stiffness and a mass; the row sums of the mass are computed."""
    sums = jnp.where(free, jnp.sum(mass.coefficients, axis=0), 1)
    return NodalPencil(stiffness, mass, jax.lax.stop_gradient(sums), free, domain)


def nodal_pencil(pencil: Pencil) -> NodalPencil:
    """Return the matrices of a grid's pencil as stencils on nodal arrays."""
    space = pencil.space
    assert isinstance(space, GridSpace)
    stiffness, mass = (
        Stencil(coefficients_of(each, space), space.periodic) for each in (pencil.stiffness, pencil.mass)
    )
    # Under `jit`, masks are constants; the optimization barrier keeps XLA from computing with masks at compile time.
    masks = (jnp.asarray(mask_for(pencil, mask)) for mask in (space.free, space.domain))
    return lump(stiffness, mass, *jax.lax.optimization_barrier(tuple(masks)))


def to_columns(rows: Float[Array, "b nodes"], shape: tuple[int, ...]) -> Float[Array, "*shape b"]:
    """Return rows of flat nodal arrays as a block of columns."""
    # Optimization barriers keep XLA from fusing the transposition, here and in `to_rows`, with matrix products, which
    # would then access memory in the wrong order.
    return jax.lax.optimization_barrier(jnp.moveaxis(rows.reshape(-1, *shape), 0, -1))


def to_rows(columns: Float[Array, "*shape b"]) -> Float[Array, "b nodes"]:
    """Return a block of columns as rows of flat nodal arrays."""
    return jnp.moveaxis(jax.lax.optimization_barrier(columns), -1, 0).reshape(columns.shape[-1], -1)
