"""The pencil of a grid on all nodes, with masks as arrays, so that all masks share compiled code."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Bool, Float

from hks_jax.domain.components import bounding_box
from hks_jax.domain.grid import Grid
from hks_jax.fem.halo import Slabs
from hks_jax.fem.pencil import Pencil
from hks_jax.fem.space import GridSpace, grid_space, mask_for
from hks_jax.fem.stencil import Stencil, StencilOperator, coefficients_of
from hks_jax.linear.chebyshev import chebyshev_iteration
from hks_jax.linear.operators import DiagonalOperator, Operator
from hks_jax.linear.symmetric_pencil import NullSpace
from hks_jax.traced import is_traced


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

    # Chebyshev iteration with m steps computes P = p(D⁻¹M)D⁻¹ with a fixed polynomial p of degree m − 1; P is therefore
    # linear and symmetric. For an eigenvalue μ of D⁻¹M in [low, 1], |1 − μ p(μ)| ≤ 1/T_m(σ), where T_m is a Chebyshev
    # polynomial and σ = (1 + low)/(1 − low). The eigenvalues of D⁻¹M are at most 1 by Gershgorin's theorem, since the
    # entries of M are not negative.
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


_ROUND = 4
"""The sides of a cropped grid are multiples of this number of nodes, so that similar masks share compiled code."""
_SAVED = 0.8
"""A grid is cropped if the nodes that remain are at most this fraction."""


def cropped(pencil: Pencil) -> Pencil:
    """Return the pencil on the part of its grid around the domain, with the same unknowns in the same order.

    Along periodic axes the grid stays whole. The pencil is returned unchanged if cropping would save few nodes, or if
    it is not that of functions on a grid.
    """
    space = pencil.space
    if not isinstance(space, GridSpace):
        return pencil
    # With a margin of a node, a new end of an axis is no side of the domain.
    whole = space.grid.inside
    around = zip(bounding_box(whole, margin=1), whole.shape, space.periodic, strict=True)
    box = tuple(slice(None) if wraps else _rounded(part, n) for part, n, wraps in around)
    inside = whole[box]
    if inside.size > _SAVED * space.free.size:
        return pencil
    small = grid_space(Grid(inside.shape, mask=inside, components="all"), space.boundary)

    def part(matrix: Any) -> Any:
        every = (slice(None), *box)
        return StencilOperator(matrix.coefficients[every], small) if isinstance(matrix, StencilOperator) else matrix

    parts = {"stiffness": part(pencil.stiffness), "mass": part(pencil.mass), "space": small}
    return replace(pencil, **parts, metric=None, density=None, source=None)


def _rounded(part: slice, n: int) -> slice:
    """Return a slice of n nodes that contains the given one, and whose length is a multiple of `_ROUND` if possible."""
    size = min(-(-(part.stop - part.start) // _ROUND) * _ROUND, n)
    first = min(part.start, n - size)
    return slice(first, first + size)


def to_columns(rows: Float[Array, "b nodes"], shape: tuple[int, ...]) -> Float[Array, "*shape b"]:
    """Return rows of flat nodal arrays as a block of columns."""
    # Optimization barriers keep XLA from fusing the transposition, here and in `to_rows`, with matrix products, which
    # would then access memory in the wrong order.
    return jax.lax.optimization_barrier(jnp.moveaxis(rows.reshape(-1, *shape), 0, -1))


def to_rows(columns: Float[Array, "*shape b"]) -> Float[Array, "b nodes"]:
    """Return a block of columns as rows of flat nodal arrays."""
    return jnp.moveaxis(jax.lax.optimization_barrier(columns), -1, 0).reshape(columns.shape[-1], -1)


_FILLED = {2: 0.45, 3: 0.6}
"""The least fraction of free nodes, for each dimension, at which `on_all_nodes` uses all nodes. With half of the nodes
free in 2D, computations on all nodes take 1.4 to 1.9 times as long as on the free nodes, so that ten calls lose the
time that the shared compilation saves. In 3D the cost of a factorisation grows faster with the number of nodes."""


def on_all_nodes(pencil: Pencil, k: int = 0) -> Pencil:
    """Return a pencil on all nodes of a grid with the same lowest eigenpairs, if that is faster.

    Each node i that is not free gets a separate equation, Kᵢᵢ = σMᵢᵢ, with an eigenvalue σ above the lowest quarter of
    the spectrum; the other eigenvectors vanish at node i. The pencil is returned unchanged if k, the number of wanted
    eigenpairs, exceeds a quarter of its size, or if it is traced, as `jax.jit` compiles code for each mask anyway.
    """
    space = pencil.space
    if 4 * k > pencil.size or is_traced(jax.lax.stop_gradient(pencil.stiffness)) or not isinstance(space, GridSpace):
        return pencil
    if not _FILLED[space.dimension] * space.free.size <= space.n_dof < space.free.size:
        return pencil
    natural = ("neumann", "neumann")
    sides = [("periodic", "periodic") if wraps else natural for wraps in space.periodic]
    whole = grid_space(Grid(space.node_shape), (*sides, natural))
    of_stiffness, of_mass = (coefficients_of(each, space) for each in (pencil.stiffness, pencil.mass))
    of_stiffness, of_mass = _with_others(of_stiffness, of_mass, space.free)
    diagonal = isinstance(pencil.mass, DiagonalOperator)
    mass: Operator = DiagonalOperator(of_mass.ravel()) if diagonal else StencilOperator(of_mass, whole)
    nulls = pencil.null_space
    if nulls is not None:
        vectors = space.extend(nulls.vectors, outside=0.0)
        nulls = NullSpace(vectors.reshape(len(vectors), whole.n_dof), nulls.fixed)
    sums = pencil.row_sums
    if sums is not None:  # where the row sum is infinite, `read` does not add neighbouring values
        sums = jnp.where(space.free, space.extend(sums, outside=0.0), jnp.inf).ravel()
    stiffness = StencilOperator(of_stiffness, whole)
    return replace(pencil, stiffness=stiffness, mass=mass, space=whole, null_space=nulls, row_sums=sums)


# The eigenvalue of the separate equations is the largest quotient Kᵢᵢ/Mᵢᵢ of the free nodes, a Rayleigh quotient, and
# so at most the largest eigenvalue of the pencil. The quotient Kᵢᵢ/Mᵢᵢ must exceed the lowest quarter of the spectrum.
# With a consistent mass and node spacing h, Kᵢᵢ/Mᵢᵢ is 6/h² in 2D and 9/h² in 3D, and the lowest quarter of the
# spectrum ends at 3.8/h² and 7.6/h². With a lumped mass, Kᵢᵢ/Mᵢᵢ is 2.7/h², and the lowest quarter of the spectrum ends
# at 2.2/h² in 2D and 2.4/h² in 3D. Because 2.7/h² is so close to the lowest quarter, the quotient of a lumped mass is
# doubled; the spectrum in 2D then ends at 5.3/h², not at 4/h².
@jax.jit
def _with_others(
    stiffness: Float[Array, "offsets *shape"], mass: Float[Array, "m *shape"], free: Bool[np.ndarray | Array, "*shape"]
) -> tuple[Float[Array, "offsets *shape"], Float[Array, "m *shape"]]:
    of_stiffness, of_mass = len(stiffness) // 2, len(mass) // 2
    diagonals = jax.lax.stop_gradient((stiffness[of_stiffness], mass[of_mass]))
    own, unit = (jnp.where(free, diagonal, 0) for diagonal in diagonals)
    size = jnp.sum(unit) / jnp.sum(free).astype(unit.dtype)
    above = (2.0 if len(mass) == 1 else 1.0) * jnp.max(own / jnp.where(free, unit, 1)) * size
    others = jnp.where(free, 0, above), jnp.where(free, 0, size)
    return stiffness.at[of_stiffness].add(others[0]), mass.at[of_mass].add(others[1])
