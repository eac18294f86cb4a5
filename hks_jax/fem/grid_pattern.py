"""The pattern of a grid's matrices, and where to cut it for nested dissection."""

from functools import lru_cache
from itertools import product

import jax
import numpy as np
from jaxtyping import Int

from hks_jax.fem.space import GridSpace
from hks_jax.linear.bisection import Parts
from hks_jax.linear.pattern import Pattern

_CELL = {2: 25, 3: 64}
"""The number of nodes from which on a cell is divided further: fewer operations against more, smaller batches."""


@jax.tree_util.register_static
class GridPattern(Pattern):
    """The couplings of a grid's free nodes with their 3^d neighbours, as places in stencil coefficients."""

    def __init__(self, space: GridSpace) -> None:
        self.space, self.size, self.n_entries = space, space.n_dof, 3**space.dimension * space.free.size

    def places(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return for each place its index into the flat coefficients, its row, and its column."""
        return _couplings(self.space)

    def diagonal(self) -> Int[np.ndarray, " n"]:
        """Return the indices of the diagonal entries."""
        return 3**self.space.dimension // 2 * self.space.free.size + np.flatnonzero(self.space.free)

    def bisect(self) -> Parts:
        """Return how to cut the grid."""
        return _bisect(self.space)

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, GridPattern) and self.space == other.space)

    def __hash__(self) -> int:
        return hash(self.space)


@lru_cache(maxsize=16)
def _couplings(space: GridSpace) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return where in the coefficients each entry lies, its row and its column, for the couplings of free nodes."""
    shape, d = space.node_shape, space.dimension
    number = space.degrees_of_freedom.reshape(shape).astype(np.int32)
    place = np.arange(number.size, dtype=np.int32).reshape(shape)
    for axis, wraps in enumerate(space.periodic):
        if wraps:
            number = np.pad(number, [(1, 1) if a == axis else (0, 0) for a in range(d)], mode="wrap")
    centre = number[tuple(slice(int(wraps), n + int(wraps)) for n, wraps in zip(shape, space.periodic, strict=True))]
    where, rows, cols = [], [], []
    for o, offset in enumerate(product((-1, 0, 1), repeat=d)):
        # Both ends of all couplings, without those across a side.
        ends = [_ends(n, k, wraps) for n, k, wraps in zip(shape, offset, space.periodic, strict=True)]
        own, others = (tuple(slices) for slices in zip(*ends, strict=True))
        row, col = centre[own].ravel(), number[others].ravel()
        both = np.flatnonzero((row >= 0) & (col >= 0))
        where.append(o * place.size + place[own].ravel()[both].astype(int))
        rows.append(row[both])
        cols.append(col[both])
    return np.concatenate(where), np.concatenate(rows), np.concatenate(cols)


def _ends(n: int, offset: int, wraps: bool) -> tuple[slice, slice]:
    """Return which nodes of an axis have a neighbour at an offset, and where these are; with a rim if it wraps."""
    if wraps:
        return slice(0, n), slice(1 + offset, 1 + offset + n)
    return slice(max(-offset, 0), n - max(offset, 0)), slice(max(offset, 0), n - max(-offset, 0))


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
