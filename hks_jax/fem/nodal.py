"""The pencil of a grid on nodal arrays, for what works with products alone: no mask, no numbering."""

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
    """K and M on one grid, its nodes' masks as arrays: what is compiled for one mask serves all.

    Attributes:
        stiffness: K.
        mass: M; a diagonal if lumped.
        lumped: (*shape,) the row sums D of M, constant to derivatives; 1 at nodes that are not free.
        free: (*shape,) nodes that carry a degree of freedom.
        domain: (*shape,) nodes of the domain: free ones, and those where functions vanish.
    """

    stiffness: Stencil
    mass: Stencil
    lumped: Float[Array, "*shape"]
    free: Bool[Array, "*shape"]
    domain: Bool[Array, "*shape"]

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of nodal arrays."""
        return self.lumped.shape

    @property
    def periodic(self) -> tuple[bool, ...]:
        """Whether each axis is."""
        return self.stiffness.periodic

    @property
    def lumped_or_zero(self) -> Float[Array, "*shape"]:
        """D, 0 at nodes that are not free."""
        return jnp.where(self.free, self.lumped, 0)

    def cut(self, mesh: Mesh | None) -> Slabs | None:
        """Return the cuts of the grid for a number of devices; None for one."""
        return None if mesh is None else Slabs(mesh, self.shape, self.periodic)

    def own(self, slabs: Slabs | None) -> "NodalPencil":
        """Return this device's share, inside of `shard_map`."""
        if slabs is None:
            return self
        masks = (slabs.own(x) for x in (self.lumped, self.free, self.domain))
        return NodalPencil(self.stiffness.own(slabs), self.mass.own(slabs), *masks)

    def products(self) -> Callable[[Float[Array, "*shape b"]], tuple[Float[Array, "*shape b"], ...]]:
        """Return x ↦ (Kx, Mx), for which neighbours are fetched once; for products in a loop, call this outside."""
        stiffness, mass = self.stiffness.of_rimmed(), self.mass.of_rimmed()

        def both(x: Float[Array, "*shape b"]) -> tuple[Float[Array, "*shape b"], ...]:
            rimmed = self.stiffness.rimmed(x)
            return stiffness(x, rimmed), mass(x, rimmed)

        return both

    # A polynomial in D⁻¹M with fixed coefficients, so that P is linear and symmetric: |1 − μ p(μ)| ≤ 1/T_m(σ) on the
    # spectrum [low, 1] of D⁻¹M, σ = (1 + low)/(1 − low). (Its upper end is 1 by Gershgorin's theorem, as the entries of
    # M are not negative.)
    def mass_solve(
        self, low: Float[Array, ""] | float, degree: int
    ) -> Callable[[Float[Array, "*shape b"]], Float[Array, "*shape b"]]:
        """Return r ↦ Pr, P ≈ M⁻¹ so many steps of Chebyshev iteration; exact where the mass is lumped."""
        inverse, mass = 1 / self.lumped[..., None], self.mass.of_columns()
        if self.mass.is_diagonal:
            return lambda r: inverse * r
        ends = jnp.asarray(low, inverse.dtype), jnp.ones((), inverse.dtype)
        return lambda r: -chebyshev_iteration(lambda x: inverse * mass(x), inverse * r, *ends, 0.0, degree)


def lump(stiffness: Stencil, mass: Stencil, free: Bool[Array, "*shape"], domain: Bool[Array, "*shape"]) -> NodalPencil:
    """Return the pencil of these matrices."""
    sums = jnp.where(free, jnp.sum(mass.coefficients, axis=0), 1)
    return NodalPencil(stiffness, mass, jax.lax.stop_gradient(sums), free, domain)


def nodal_pencil(pencil: Pencil) -> NodalPencil:
    """Return a grid's pencil on nodal arrays."""
    space = pencil.space
    assert isinstance(space, GridSpace)
    stiffness, mass = (
        Stencil(coefficients_of(each, space), space.periodic) for each in (pencil.stiffness, pencil.mass)
    )
    # Under `jit` they are known, and without the barrier the compiler would compute with them, node by node.
    masks = (jnp.asarray(mask_for(pencil, mask)) for mask in (space.free, space.domain))
    return lump(stiffness, mass, *jax.lax.optimization_barrier(tuple(masks)))


def to_columns(rows: Float[Array, "b nodes"], shape: tuple[int, ...]) -> Float[Array, "*shape b"]:
    """Return rows of flat nodal arrays as a block of columns."""
    # The barriers, here and below, keep XLA from fusing the transposition with the products before or after it, which
    # would then go through memory in the wrong order.
    return jax.lax.optimization_barrier(jnp.moveaxis(rows.reshape(-1, *shape), 0, -1))


def to_rows(columns: Float[Array, "*shape b"]) -> Float[Array, "b nodes"]:
    """Return a block of columns as rows of flat nodal arrays."""
    return jnp.moveaxis(jax.lax.optimization_barrier(columns), -1, 0).reshape(columns.shape[-1], -1)
