"""Finite element spaces, their degrees of freedom and null vectors, and masks as arrays for computations."""

import math
from collections.abc import Sequence
from functools import cached_property, lru_cache, reduce
from itertools import product
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from hks_jax.arrays import ByKey
from hks_jax.compilation import library_of, numpy_where_known
from hks_jax.domain.components import active_elements, bounding_box, element_nodes, label_nodes, rim_nodes, wrap_nodes
from hks_jax.domain.grid import Grid
from hks_jax.domain.triangulation import Triangulation
from hks_jax.fem.boundary import Sides
from hks_jax.fem.halo import neighbours, with_rim
from hks_jax.traced import is_staged, is_traced

_COPIED = 1 << 22
"""The largest number of values that NumPy copies in less time than a compilation takes."""
_ROUND = {2: 16, 3: 4}
"""The sides of a box are multiples of this number of nodes, for each dimension, so that boxes of similar masks agree.
In 3D, where additional nodes cost more time than compilation, the number is smaller."""
_SAVED = 0.8
"""A grid is cropped if the nodes that remain are at most this fraction."""


class FunctionSpace(ByKey):
    """The nodes of a domain, and the free nodes, which carry a degree of freedom. Static and hashable."""

    node_shape: tuple[int, ...]  # the shape of a nodal array: the grid's shape, or (V,)
    dimension: int  # the dimension of the manifold
    degree: int = 1  # the degree of the finite elements
    domain: Bool[np.ndarray, "*node_shape"]  # the nodes of the domain; results are NaN elsewhere
    free: Bool[np.ndarray, "*node_shape"]  # the nodes that carry a degree of freedom; Dirichlet nodes are not free
    boundary: tuple[Sides, ...]  # the conditions of each axis and of the rim of a mask; for a mesh one pair
    n_components: int  # the number of connected components of the domain
    elements: Bool[np.ndarray, "*elements"]  # the elements in the domain; a grid axis has n − 1 or, if periodic, n
    labels: Int[np.ndarray, "*node_shape"]  # the connected component of each node of the domain

    def __repr__(self) -> str:
        """Return one line: the degrees of freedom, the nodes and the boundary."""
        return (
            f"{type(self).__name__}({self.n_dof} unknowns, nodes={self.node_shape}, boundary={self.boundary}, "
            f"n_components={self.n_components})"
        )

    @property
    def n_dof(self) -> int:
        """The number of degrees of freedom."""
        return self._free_indices.size

    @cached_property
    def _free_indices(self) -> np.ndarray:
        return np.flatnonzero(self.free)

    @cached_property
    def degrees_of_freedom(self) -> Int[np.ndarray, " nodes"]:
        """The index of each node's degree of freedom, or −1 at nodes without one; nodes are in flat order."""
        numbers = np.full(self.free.size, -1)
        numbers[self._free_indices] = np.arange(self.n_dof)
        return numbers

    @property
    def _all_free(self) -> bool:
        return self.n_dof == self.free.size

    @cached_property
    def null_labels(self) -> Int[np.ndarray, " n_dof"]:
        """The index of the null vector that is 1 at each degree of freedom, or −1 where all null vectors are 0.

        The null vectors are 1 on one connected component of the domain without Dirichlet nodes, and 0 elsewhere.
        """
        pinned = np.unique(self.labels[self.domain & ~self.free])
        labels = self.labels.ravel()[self._free_indices]
        kept = np.setdiff1d(np.unique(labels), pinned)
        return np.where(np.isin(labels, kept), np.searchsorted(kept, labels), -1)

    @property
    def n_null(self) -> int:
        """The number of zero eigenvalues, one for each connected component of the domain without Dirichlet nodes."""
        return int(self.null_labels.max(initial=-1)) + 1

    def restrict(self, nodal: Float[Array, "*leading_and_node_shape"]) -> Float[Array, "... n_dof"]:
        """Return the values at the free nodes."""
        flat = _reshaped(nodal, (*nodal.shape[: nodal.ndim - len(self.node_shape)], self.free.size))
        return flat if self._all_free else taken(flat, self._free_indices)

    def extend(
        self, values: Float[Array, "... n_dof"], outside: float = float("nan")
    ) -> Float[Array, "*leading_and_node_shape"]:
        """Put values at the free nodes, zero at Dirichlet nodes, and ``outside`` at nodes outside the domain."""
        shape = (*values.shape[:-1], *self.node_shape)
        if self._all_free:
            return _reshaped(values, shape)
        fill = np.where(self.domain.ravel(), 0.0, outside).astype(values.dtype)
        with jax.debug_nans(False):  # NaN is intended outside the domain
            return _reshaped(_spread(values, self._free_indices, fill), shape)

    def transfer(self, values: Float[Array, "... n_dof"], to: "FunctionSpace") -> Float[Array, "... n"]:
        """Convert functions to another space on the same nodes; the results are 0 at Dirichlet nodes of that space."""
        return values if to == self else to.restrict(self.extend(values, outside=0.0))


@numpy_where_known(most=_COPIED, static_argnums=1)
def _reshaped(values: Any, shape: tuple[int, ...]) -> Any:
    return values.reshape(shape)


# The indices are arguments, so that index arrays of equal length share one compilation.
@numpy_where_known(most=_COPIED)
def taken(values: Any, indices: Any) -> Any:
    """Return the values (…, m) at given indices of the last axis."""
    return values.take(indices, axis=-1, mode="clip")


@numpy_where_known(most=_COPIED)
def _spread(values: Any, indices: Any, fill: Any) -> Any:
    leading = (*values.shape[:-1], 1)
    if library_of(values) is np:
        full = np.tile(fill, leading)
        full[..., indices] = values
        return full
    return jnp.tile(fill, leading).at[..., indices].set(values, unique_indices=True, indices_are_sorted=True)


@jax.tree_util.register_static
class GridSpace(FunctionSpace):
    """The Q1 space on a grid with given boundary conditions, as returned by `normalise_boundary`.

    The space does not contain the grid's spacing and origin, which can change without recompilation.
    """

    def __init__(self, grid: Grid, boundary: tuple[Sides, ...]) -> None:
        self.grid, self.boundary = grid.unit, boundary
        self.node_shape, self.dimension = grid.shape, grid.dimension
        *axes, rim = boundary
        self.periodic = tuple(sides == ("periodic", "periodic") for sides in axes)
        if any(wraps and n < 3 for wraps, n in zip(self.periodic, grid.shape, strict=True)):
            raise ValueError(f'boundary: got "periodic" for shape {grid.shape}; a periodic axis needs at least 3 nodes')
        self.elements = active_elements(grid.inside, self.periodic)
        self.domain = element_nodes(self.elements, self.periodic)
        if not self.domain.any():
            raise ValueError("mask: no element has all its nodes inside the mask; use a thicker mask or a finer grid")
        self.free = self.domain.copy()
        for axis, sides in enumerate(axes):
            for end, condition in zip((0, -1), sides, strict=True):
                if condition == "dirichlet":
                    self.free[(slice(None),) * axis + (end,)] = False
        if "dirichlet" in rim:
            self.free &= ~rim_nodes(self.elements, self.periodic)
        if not self.free.any():
            raise ValueError(
                f"boundary: every node of the domain is on a Dirichlet side or rim (grid shape {grid.shape}); use a "
                "finer grid or a thicker mask"
            )
        self.labels, self.n_components = label_nodes(grid.inside, self.periodic)
        self._key = (self.grid, boundary)

    @cached_property
    def cells(self) -> Int[np.ndarray, "E n"]:
        """The nodes of each element of the domain."""
        return cells_of(self.elements, self.node_shape, self.periodic)

    @property
    def whole(self) -> "GridSpace":
        """The space of all nodes of the grid, with the same periodic axes and otherwise natural sides."""
        natural = ("neumann", "neumann")
        sides = [("periodic", "periodic") if wraps else natural for wraps in self.periodic]
        return grid_space(Grid(self.node_shape), (*sides, natural))

    @cached_property
    def around(self) -> tuple[tuple[slice, ...], "GridSpace"]:
        """The slices of the box around the domain, and the space with the same unknowns on the nodes of the box.

        Along periodic axes the box has all nodes. If the box would have hardly fewer nodes than the grid, it is the
        grid.
        """
        # With a margin of a node, a new end of an axis is no side of the domain.
        whole, step = self.grid.inside, _ROUND[self.dimension]
        ends = zip(bounding_box(whole, margin=1), whole.shape, self.periodic, strict=True)
        box = tuple(slice(None) if wraps else _rounded(part, n, step) for part, n, wraps in ends)
        inside = whole[box]
        if inside.size > _SAVED * whole.size:
            return (slice(None),) * self.dimension, self
        return box, grid_space(Grid(inside.shape, mask=inside, components="all"), self.boundary)


def _rounded(part: slice, n: int, step: int) -> slice:
    """Return a slice of n nodes that contains the given one, and whose length is a multiple of ``step`` if possible."""
    size = min(-(-(part.stop - part.start) // step) * step, n)
    first = min(part.start, n - size)
    return slice(first, first + size)


def cells_of(
    elements: Bool[np.ndarray, "*elements"], shape: tuple[int, ...], periodic: tuple[bool, ...]
) -> Int[np.ndarray, "E n"]:
    """Return the nodes of each marked element of a grid, in the order of ``product((0, 1), repeat=d)``."""
    numbers = wrap_nodes(np.arange(math.prod(shape)).reshape(shape), periodic)
    corners = product(*[(slice(None, -1), slice(1, None))] * len(shape))
    return np.stack([numbers[corner] for corner in corners], axis=-1)[elements]


@jax.tree_util.register_static
class MeshSpace(FunctionSpace):
    """The space of P1 or P2 elements on a mesh of triangles or tetrahedra.

    The nodes of a cell are its vertices and, for degree 2, the midpoints of its edges: node ``n_vertices + e`` belongs
    to edge e of the triangulation.
    """

    def __init__(self, triangulation: Triangulation, condition: str, degree: int = 1) -> None:
        self.triangulation, self.degree = triangulation, degree
        self.boundary = ((condition, condition),)
        self.cells, self.dimension = triangulation.cells, triangulation.dimension
        rim, (labels, self.n_components) = triangulation.boundary_vertices, triangulation.labels
        self.domain = triangulation.used
        if degree == 2:
            self.cells = np.concatenate([self.cells, triangulation.n_vertices + triangulation.cell_edges], axis=1)
            rim = np.concatenate([rim, triangulation.boundary_edges])
            labels = np.concatenate([labels, labels[triangulation.edges[:, 0]]])
            self.domain = np.concatenate([self.domain, np.ones(len(triangulation.edges), bool)])
        self.node_shape, self.elements = rim.shape, np.ones(len(self.cells), bool)
        self.free = self.domain & ~rim if condition == "dirichlet" else self.domain
        if not self.free.any():
            raise ValueError("boundary: every vertex is on the mesh's boundary, and so none is free. Refine the mesh")
        self.labels, self._key = labels, (triangulation, condition, degree)


@jax.tree_util.register_static
class VectorSpace(FunctionSpace):
    """Functions with several components on the nodes of a scalar space; results have a last axis of components."""

    def __init__(self, base: "GridSpace | MeshSpace", components: int) -> None:
        self.base, self.components = base, components
        self.node_shape, self.dimension, self.degree = (*base.node_shape, components), base.dimension, base.degree
        self.domain, self.free, self.labels = (
            np.repeat(x[..., None], components, axis=-1) for x in (base.domain, base.free, base.labels)
        )
        self.boundary, self.n_components, self.elements = base.boundary, base.n_components, base.elements
        self.cells = (base.cells[..., None] * components + np.arange(components)).reshape(len(base.cells), -1)
        self._key = (base, components)


@jax.tree_util.register_static
class MatrixSpace(FunctionSpace):
    """The nodes of the user's matrices, for which only the shape of nodal arrays is known."""

    dimension: int | None  # type: ignore[assignment]  # None if it is not known

    def __init__(self, shape: tuple[int, ...], dimension: int | None = None) -> None:
        self.node_shape, self.dimension, self.boundary = shape, dimension, ()
        self.domain = self.free = np.ones(shape, bool)
        self.n_components, self.labels = 1, np.zeros(shape, int)
        self._key = (shape, dimension)


def grid_space(grid: Grid, boundary: tuple[Sides, ...]) -> GridSpace:
    """Return the space of a grid; grids with the same nodes share one space."""
    return _unit_space(grid.unit, boundary)


_unit_space = lru_cache(maxsize=32)(GridSpace)
mesh_space = lru_cache(maxsize=32)(MeshSpace)
vector_space = lru_cache(maxsize=32)(VectorSpace)


def axis_colours(n: int, spacing: int, wraps: bool) -> Int[np.ndarray, " n"]:
    """Return the colours of the nodes along one axis; nodes of the same colour are at least ``spacing`` nodes apart."""
    if not wraps:
        return np.arange(n) % min(spacing, n)
    # The axis is split into as many runs of at least `spacing` nodes as fit; a colour is the index within a run.
    runs = max(n // spacing, 1)
    return np.concatenate([np.arange(len(run)) for run in np.array_split(np.arange(n), runs)])


def mask_for(values: Any, mask: Bool[np.ndarray, "*shape"]) -> Bool[np.ndarray | Array, "*shape"]:
    """Return the mask, as a JAX array if it is an outer product over axes and ``values`` are traced under `jit`."""
    axes = _axes_of(mask) if is_traced(values) and is_staged() else None
    return mask if axes is None else _outer([axis[None] for axis in axes])[0]


def couplings_for(values: Any, space: GridSpace) -> Bool[np.ndarray | Array, "offsets *shape"] | None:
    """Return the mask (offsets, *shape) of the couplings of a stencil between two free nodes.

    For ``values`` traced under `jit`, the mask is a JAX array if possible, or None if all nodes of the domain are free.
    """
    staged = is_traced(values) and is_staged()
    if staged and (space.free == space.domain).all():
        return None
    axes = _axes_of(space.free) if staged else None
    if axes is None:
        return _free_couplings(space)
    return _outer([_coupled(axis, (wraps,)) for axis, wraps in zip(axes, space.periodic, strict=True)])


@lru_cache(maxsize=16)
def _free_couplings(space: GridSpace) -> Bool[np.ndarray, "offsets *shape"]:
    return _coupled(space.free, space.periodic)


def _coupled(free: Bool[np.ndarray, "*shape"], periodic: tuple[bool, ...]) -> Bool[np.ndarray, "offsets *shape"]:
    return np.stack([free & other for other in neighbours(with_rim(free, periodic), free.ndim)])


def _axes_of(mask: Bool[np.ndarray, "*shape"]) -> list[Bool[np.ndarray, " _n"]] | None:
    """Return one mask per axis whose outer product is the given mask; None if no such masks exist."""
    d = mask.ndim
    axes = [np.asarray(mask.any(axis=tuple(a for a in range(d) if a != axis))) for axis in range(d)]
    return axes if mask[np.ix_(*axes)].all() else None


def _outer(axes: Sequence[Bool[np.ndarray, "_m _n"]]) -> Bool[Array, "ms *ns"]:
    """Return the products (m₁m₂⋯, n₁, n₂, …) of masks (m₁, n₁), (m₂, n₂), … along each axis."""
    d, shapes = len(axes), np.array([axis.shape for axis in axes]).T
    whole = tuple(map(int, shapes.ravel()))
    result = jnp.ones((), bool)
    if not all(axis.all() for axis in axes):
        # The optimization barrier keeps the compiler from computing the outer product during compilation.
        masks = jax.lax.optimization_barrier([jnp.asarray(axis) for axis in axes])
        places = [tuple(n if i % d == axis else 1 for i, n in enumerate(whole)) for axis in range(d)]
        result = reduce(jnp.logical_and, [axis.reshape(place) for axis, place in zip(masks, places, strict=True)])
    return jnp.broadcast_to(result, whole).reshape(-1, *whole[d:])
