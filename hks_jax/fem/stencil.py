"""Matrices on grids: stencils on nodal arrays and on degrees of freedom, their pattern, and where to cut it."""

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
"""The number of nodes from which on a cell is divided further: fewer operations against more, smaller batches."""


@jax.tree_util.register_static
class GridPattern(ByKey, Pattern):
    """The couplings of a grid's free nodes with their 3^d neighbours, as places in stencil coefficients."""

    def __init__(self, space: GridSpace) -> None:
        self.space, self.size, self.n_entries = space, space.n_dof, 3**space.dimension * space.free.size
        self._key = space

    def places(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return for each place its index into the flat coefficients, its row, and its column."""
        return _couplings(self.space)

    def diagonal(self) -> Int[np.ndarray, " n"]:
        """Return the indices of the diagonal entries."""
        return 3**self.space.dimension // 2 * self.space.free.size + np.flatnonzero(self.space.free)

    def bisect(self) -> Parts:
        """Return how to cut the grid."""
        return _bisect(self.space)


@lru_cache(maxsize=16)
def _couplings(space: GridSpace) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return where in the coefficients each entry lies, its row and its column, for the couplings of free nodes."""
    own = space.degrees_of_freedom.reshape(space.node_shape).astype(np.int32)
    rimmed = own
    for axis, wraps in enumerate(space.periodic):
        widths = [(1, 1) if a == axis else (0, 0) for a in range(own.ndim)]
        rimmed = np.pad(rimmed, widths, mode="wrap") if wraps else np.pad(rimmed, widths, constant_values=-1)
    where, rows, cols = [], [], []
    for o, start in enumerate(product((0, 1, 2), repeat=own.ndim)):
        other = rimmed[tuple(slice(s, s + n) for s, n in zip(start, own.shape, strict=True))]
        both = np.flatnonzero((own >= 0) & (other >= 0))
        where.append(o * own.size + both)
        rows.append(own.ravel()[both])
        cols.append(other.ravel()[both])
    return np.concatenate(where), np.concatenate(rows), np.concatenate(cols)


def _bisect(space: GridSpace) -> Parts:
    """Cut across lines of nodes or two (planes in 3D), at the median of the longest side."""
    x = np.stack(np.nonzero(space.free)).astype(np.int32)
    d, n = x.shape
    level, part, left, q = np.zeros(n, np.int8), np.zeros(n, int), np.arange(n), np.zeros(n, int)
    depth = 0
    while True:
        parts = 1 << depth
        counts = np.bincount(q, minlength=parts)
        if counts.max() <= _CELL[d]:
            level[left], part[left] = depth, q
            return Parts(level, part, depth + 1)
        # Cut every part across its longest side, at the median.
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
        if d == 2:  # two lines of an even number leave equal halves, and batches without padding
            even = (highest - lowest) % 2 == 1
            separates |= (beyond == -1) & even[q]
        if depth == 0:  # what is cut once more here is no longer periodic
            separates |= np.any(x[list(space.periodic)] == 0, axis=0)
        cutting, stays = np.flatnonzero(separates), np.flatnonzero(~separates)
        level[left[cutting]], part[left[cutting]] = depth, q[cutting]
        q = 2 * q[stays] + (beyond[stays] > 0)
        left, x = left[stays], np.take(x, stays, axis=1)
        depth += 1


class Stencil(eqx.Module):
    """A matrix that couples a node of a grid to its 3^d neighbours, applied to nodal columns (*shape, b).

    In this layout each coefficient is read once for all columns: in 3D it is about twice as fast as row after row. What
    is compiled for one stencil serves all of its shape, whatever their masks.

    Attributes:
        coefficients: (3^d, *shape), offsets in the order of ``product((-1, 0, 1), repeat=d)``: the entry at o and i
            couples node i to i + offset(o). Or (1, *shape), a diagonal. Those across a side that is not periodic are 0.
        periodic: per axis, whether node n is node 0 again; static.
        slabs: how the grid is cut, where this is one device's share of it, inside of `shard_map`; static.
    """

    coefficients: Float[Array, "offsets *shape"]
    periodic: tuple[bool, ...] = eqx.field(static=True)
    slabs: Slabs | None = eqx.field(default=None, static=True)

    @property
    def is_diagonal(self) -> bool:
        """Whether there is a single coefficient per node, as a lumped mass has it."""
        return self.coefficients.shape[0] == 1

    def own(self, slabs: Slabs) -> "Stencil":
        """Return this device's share."""
        return Stencil(slabs.own(self.coefficients, 1), self.periodic, slabs)

    def __matmul__(self, x: Float[Array, "*shape b"]) -> Float[Array, "*shape b"]:
        """Return one product; for products in a loop, see `of_columns`."""
        return self.of_columns()(x)

    def of_columns(self) -> Callable[[Float[Array, "*shape b"]], Float[Array, "*shape b"]]:
        """Return the product with columns.

        What is done to the coefficients is done here: for products in a loop, call this outside.
        """
        apply = self.of_rimmed()
        return (lambda x: apply(x, x)) if self.is_diagonal else (lambda x: apply(x, self.rimmed(x)))

    def rimmed(self, x: Float[Array, "*shape b"]) -> Float[Array, "..."]:
        """Return columns together with their neighbours beyond the sides, as `of_rimmed` takes them."""
        if self.slabs is not None:
            return self.slabs.with_halo(x)
        if any(self.periodic):
            return with_rim(x, self.periodic)
        _, reach = _distances(x.shape[:-1])
        return jnp.pad(x.reshape(-1, x.shape[-1]), ((reach, reach), (0, 0)))

    def of_rimmed(self) -> Callable[[Float[Array, "*shape b"], Float[Array, "..."]], Float[Array, "*shape b"]]:
        """Return the product with columns x, given x and `rimmed` x, which several stencils can share."""
        if self.is_diagonal:
            return lambda x, _: self.coefficients[0][..., None] * x
        if self.slabs is not None or any(self.periodic):
            of_box = product_with_rim(self.coefficients)
            return lambda _, rimmed: of_box(rimmed)
        # Node after node in one row, a neighbour is a fixed distance away. Across the sides, where the row goes on
        # elsewhere, there is nothing: elements end there, and their entries were never written.
        distances, reach = _distances(self.coefficients.shape[1:])
        row = side_by_side(self.coefficients).reshape(-1, len(distances))
        nodes = len(row)
        # On accelerators an array for each offset, behind a barrier: XLA would take them apart anew for each product.
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
        """Return Σ_b p[i, b] x[i + o, b] for every offset: the derivative of Σ_b pᵀCx by the coefficients of C."""
        shifts = [x] if self.is_diagonal else neighbours(with_rim(x, self.periodic), len(self.periodic))
        return jnp.stack([jnp.sum(p * shifted, axis=-1) for shifted in shifts])


def _distances(shape: tuple[int, ...]) -> tuple[list[int], int]:
    """Return how far away each neighbour is where the nodes stand in one row, and the largest of these."""
    strides = [math.prod(shape[axis + 1 :]) for axis in range(len(shape))]
    distances = [sum(map(mul, offset, strides)) for offset in product((-1, 0, 1), repeat=len(shape))]
    return distances, distances[-1]


def coefficients_of(operator: Operator, space: GridSpace) -> Float[Array, "offsets *shape"]:
    """Return the coefficients of a grid's matrix, (1, *shape) of a diagonal one."""
    if isinstance(operator, DiagonalOperator):
        return space.extend(operator.entries, outside=0.0)[None]
    assert isinstance(operator, StencilOperator)
    return operator.coefficients


class StencilOperator(PatternedOperator):
    """A stencil on the free nodes of a grid: 9 coefficients a node in 2D, 27 in 3D.

    ``coefficients`` are those of a `Stencil`. Couplings to nodes that are not free are zero.
    """

    coefficients: Float[Array, "offsets *shape"]
    space: GridSpace = eqx.field(static=True)

    @property
    def pattern(self) -> GridPattern:
        """Where the entries are."""
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
            # Behind the barrier the neighbours are slices of an array, and not what decides of each node where it is.
            rimmed = jax.lax.optimization_barrier(with_rim(row, self.space.periodic))
            terms = zip(coefficients, neighbours(rimmed, len(shape)), strict=True)
            return reduce(add, (c * shifted for c, shifted in terms))

        rows = self.space.extend(x, outside=0.0).reshape(-1, *shape)
        return self.space.restrict(of_each_row(product_with, rows).reshape(*x.shape[:-1], *shape))

    def of_columns(self) -> OfColumns:
        """Return the product with a block of columns, twice as fast as with rows."""
        shape = self.space.node_shape
        product_with = Stencil(self.coefficients, self.space.periodic).of_columns()
        free, numbers = np.flatnonzero(self.space.free), self.space.degrees_of_freedom
        if free.size == numbers.size:
            return lambda x: product_with(x.reshape(*shape, -1)).reshape(x.shape)
        numbers = np.where(numbers < 0, free.size, numbers)  # out of range, where there is none

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
