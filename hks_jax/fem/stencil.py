"""Matrices on grids: stencils on nodal arrays or on degrees of freedom, their sparsity pattern and bisection."""

import math
from collections.abc import Callable
from functools import lru_cache, reduce
from itertools import product
from operator import add, mul

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from hks_jax.arrays import ByKey
from hks_jax.fem.halo import Slabs, neighbours, product_with_rim, side_by_side, with_rim
from hks_jax.fem.space import GridSpace, taken
from hks_jax.linear import accelerators
from hks_jax.linear.bisection import Parts
from hks_jax.linear.operators import DiagonalOperator, OfColumns, Operator, PatternedOperator, Places
from hks_jax.linear.pattern import Pattern
from hks_jax.linear.products import of_each_row

_CELL = {2: 25, 3: 64}
"""The number of nodes up to which bisection leaves a part whole; smaller numbers save operations, but add batches."""


@jax.tree_util.register_static
class GridPattern(ByKey, Pattern):
    """The couplings of a grid's free nodes with their 3^d neighbours, as indices into stencil coefficients."""

    def __init__(self, space: GridSpace) -> None:
        self.space, self.size, self.n_entries = space, space.n_dof, 3**space.dimension * space.free.size
        self._key = space

    def places(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return for each entry its index into the flat coefficients, its row and its column."""
        return _couplings(self.space)

    def diagonal(self) -> Int[np.ndarray, " n"]:
        """Return the indices of the diagonal entries."""
        return 3**self.space.dimension // 2 * self.space.free.size + np.flatnonzero(self.space.free)

    def bisect(self) -> Parts:
        """Bisect the grid recursively at the median of each part's longest side, by lines of nodes (in 3D, planes)."""
        x = np.stack(np.nonzero(self.space.free)).astype(np.int32)
        d, n = x.shape
        level, part, left, q = np.zeros(n, np.int8), np.zeros(n, int), np.arange(n), np.zeros(n, int)
        depth = 0
        while True:
            parts = 1 << depth
            counts = np.bincount(q, minlength=parts)
            if counts.max() <= _CELL[d]:
                level[left], part[left] = depth, q
                return Parts(level, part, depth + 1)
            low, high = np.full((d, parts), np.iinfo(np.int32).max, np.int32), np.full((d, parts), -1, np.int32)
            for axis in range(d):
                np.minimum.at(low[axis], q, x[axis])
                np.maximum.at(high[axis], q, x[axis])
            longest = np.argmax(high - low, axis=0)
            lowest, highest = (ends[longest, np.arange(parts)] for ends in (low, high))
            across, along = longest.astype(np.int8)[q], x[0]
            for axis in range(1, d):
                along = np.where(across == axis, x[axis], along)
            extent = int(np.max(highest - lowest)) + 1
            first = np.arange(parts) * extent - lowest
            sizes = np.bincount(first[q] + along, minlength=parts * extent).reshape(parts, extent)
            cut = lowest + np.argmax(np.cumsum(sizes, axis=1) > counts[:, None] // 2, axis=1).astype(np.int32)
            beyond = along - cut[q]
            separates = beyond == 0
            if d == 2:  # with an even number of lines, two cut lines leave equal halves, and so batches without padding
                even = (highest - lowest) % 2 == 1
                separates |= (beyond == -1) & even[q]
            if depth == 0:  # also cut periodic axes at node 0, so that the parts are not periodic
                separates |= np.any(x[list(self.space.periodic)] == 0, axis=0)
            cutting, stays = np.flatnonzero(separates), np.flatnonzero(~separates)
            level[left[cutting]], part[left[cutting]] = depth, q[cutting]
            q = 2 * q[stays] + (beyond[stays] > 0)
            left, x = left[stays], np.take(x, stays, axis=1)
            depth += 1


@lru_cache(maxsize=16)
def _couplings(space: GridSpace) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    # A node's entry is 1 plus the index of its degree of freedom, or 0 if the node is not free.
    own = (space.degrees_of_freedom + 1).reshape(space.node_shape).astype(np.int32)
    where, rows, cols = [], [], []
    for o, other in enumerate(neighbours(with_rim(own, space.periodic), own.ndim)):
        both = np.flatnonzero((own > 0) & (other > 0))
        where.append(o * own.size + both)
        rows.append(own.ravel()[both] - 1)
        cols.append(other.ravel()[both] - 1)
    short = np.int32 if 3**own.ndim * own.size <= np.iinfo(np.int32).max else np.int64
    return np.concatenate(where).astype(short), np.concatenate(rows), np.concatenate(cols)


class Stencil(eqx.Module):
    """A matrix that couples each node of a grid to its 3^d neighbours, applied to blocks of nodal columns (*shape, b).

    A product reads each coefficient once for all columns of a block. In 3D, products with blocks are about twice as
    fast as products with single rows. Stencils of the same shape share compiled code, even if their masks differ.

    The offsets o of the coefficients are in the order of ``product((-1, 0, 1), repeat=d)``: entry (o, i) couples node i
    to node i + o. A diagonal matrix has coefficients (1, *shape). Couplings across non-periodic sides are 0.
    """

    coefficients: Float[Array, "offsets *shape"]
    periodic: tuple[bool, ...] = eqx.field(static=True)  # whether each axis is periodic
    slabs: Slabs | None = eqx.field(default=None, static=True)  # the grid's division, if the stencil is for a slab

    @property
    def is_diagonal(self) -> bool:
        """Whether each node has a single coefficient, as with a lumped mass."""
        return self.coefficients.shape[0] == 1

    def own(self, slabs: Slabs) -> "Stencil":
        """Return this device's slab of the stencil."""
        return Stencil(slabs.own(self.coefficients, 1), self.periodic, slabs)

    def __matmul__(self, x: Float[Array, "*shape b"]) -> Float[Array, "*shape b"]:
        """Return the product with columns; for products in a loop, see `of_columns`."""
        return self.of_columns()(x)

    def of_columns(self) -> Callable[[Float[Array, "*shape b"]], Float[Array, "*shape b"]]:
        """Return the function that multiplies columns; call `of_columns` outside loops: it rearranges coefficients."""
        apply = self.of_rimmed()
        return (lambda x: apply(x, x)) if self.is_diagonal else (lambda x: apply(x, self.rimmed(x)))

    def rimmed(self, x: Float[Array, "*shape b"]) -> Float[Array, "..."]:
        """Pad columns by the nodes beyond the sides, as the function that `of_rimmed` returns requires."""
        if self.slabs is not None:
            return self.slabs.with_halo(x)
        if any(self.periodic):
            return with_rim(x, self.periodic)
        _, reach = _distances(x.shape[:-1])
        return jnp.pad(x.reshape(-1, x.shape[-1]), ((reach, reach), (0, 0)))

    def of_rimmed(self) -> Callable[[Float[Array, "*shape b"], Float[Array, "..."]], Float[Array, "*shape b"]]:
        """Return the product as a function of x and ``rimmed(x)``, so that several stencils can share ``rimmed(x)``."""
        if self.is_diagonal:
            return lambda x, _: self.coefficients[0][..., None] * x
        if self.slabs is not None or any(self.periodic):
            of_box = product_with_rim(self.coefficients)
            return lambda _, rimmed: of_box(rimmed)
        # In the flat order of the nodes, each neighbour is at a fixed distance. If this distance leads across a side of
        # the grid, the coefficient of the neighbour is zero, since no element couples the two nodes.
        distances, reach = _distances(self.coefficients.shape[1:])
        row = side_by_side(self.coefficients).reshape(-1, len(distances))
        nodes = len(row)
        # Accelerators use one array per offset. Without the barrier, XLA would split the array again for each product.
        apart = jax.lax.optimization_barrier(jnp.split(row, len(distances), axis=1)) if accelerators.at_hand() else ()

        def of_row(x: Float[Array, "*shape b"], padded: Float[Array, "padded b"]) -> Float[Array, "*shape b"]:
            b = x.shape[-1]
            y = jnp.zeros((), x.dtype)
            for o, distance in enumerate(distances):
                own = apart[o] if apart else row[:, o, None]
                y = y + own * jax.lax.slice(padded, (reach + distance, 0), (reach + distance + nodes, b))
            return y.reshape(x.shape)

        return of_row

    def outer(self, p: Float[Array, "*shape b"], x: Float[Array, "*shape b"]) -> Float[Array, "offsets *shape"]:
        """Return Σ_b p[i, b] x[i + o, b]: the derivative of Σ_b pᵀCx by the coefficient C of node i and offset o."""
        shifts = [x] if self.is_diagonal else neighbours(with_rim(x, self.periodic), len(self.periodic))
        return jnp.stack([jnp.sum(p * shifted, axis=-1) for shifted in shifts])


def _distances(shape: tuple[int, ...]) -> tuple[list[int], int]:
    """Return the distances of the neighbours of a node in the flat order of the nodes, and the largest distance."""
    strides = [math.prod(shape[axis + 1 :]) for axis in range(len(shape))]
    distances = [sum(map(mul, offset, strides)) for offset in product((-1, 0, 1), repeat=len(shape))]
    return distances, distances[-1]


def coefficients_of(operator: Operator, space: GridSpace) -> Float[Array, "offsets *shape"]:
    """Return the stencil coefficients of a grid's matrix, which are (1, *shape) for a diagonal matrix."""
    if isinstance(operator, DiagonalOperator):
        return space.extend(operator.entries, outside=0.0)[None]
    assert isinstance(operator, StencilOperator)
    return operator.coefficients


class StencilOperator(PatternedOperator):
    """A stencil on the free nodes of a grid; couplings to nodes that are not free are zero."""

    coefficients: Float[Array, "offsets *shape"]
    space: GridSpace = eqx.field(static=True)

    @property
    def pattern(self) -> GridPattern:
        """The sparsity pattern."""
        return GridPattern(self.space)

    def flat(self) -> Float[Array, " m"]:
        """Return the coefficients."""
        return self.coefficients.reshape(-1)

    def with_flat(self, entries: Float[Array, " m"]) -> "StencilOperator":
        """Return the matrix with other coefficients."""
        return StencilOperator(entries.reshape(self.coefficients.shape), self.space)

    def apply(self, x: Float[Array, "... n_dof"]) -> Float[Array, "... n_dof"]:
        """Apply the operator along the last axis."""
        shape, coefficients = self.space.node_shape, list(self.coefficients)

        def product_with(row: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
            # With an optimization barrier, neighbours are slices of one padded array; else XLA would pad for each node.
            rimmed = jax.lax.optimization_barrier(with_rim(row, self.space.periodic))
            terms = zip(coefficients, neighbours(rimmed, len(shape)), strict=True)
            return reduce(add, (c * shifted for c, shifted in terms))

        rows = self.space.extend(x, outside=0.0).reshape(-1, *shape)
        return self.space.restrict(of_each_row(product_with, rows).reshape(*x.shape[:-1], *shape))

    def of_columns(self) -> OfColumns:
        """Return the function that multiplies a block of columns, twice as fast as `apply` multiplies rows."""
        shape = self.space.node_shape
        product_with = Stencil(self.coefficients, self.space.periodic).of_columns()
        free, numbers = np.flatnonzero(self.space.free), self.space.degrees_of_freedom
        if free.size == numbers.size:
            return lambda x: product_with(x.reshape(*shape, -1)).reshape(x.shape)
        numbers = np.where(numbers < 0, free.size, numbers)  # an index out of range where a node is not free

        def product_of_free(x: Float[Array, "n_dof b"]) -> Float[Array, "n_dof b"]:
            nodal = x.at[numbers].get(mode="fill", fill_value=0)
            return product_with(nodal.reshape(*shape, -1)).reshape(nodal.shape)[free]

        return product_of_free

    def triplets(self) -> tuple[Float[Array, " nnz"], Places]:
        """Return the entries and their static (rows, columns)."""
        where, rows, cols = self.pattern.places()
        return taken(self.flat(), where), (rows, cols)

    def diagonal(self) -> Float[Array, " n_dof"]:
        """Return the main diagonal."""
        return self.space.restrict(self.coefficients[self.coefficients.shape[0] // 2])
