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
        self.space, self.size = space, space.n_dof

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
    for axis, wraps in enumerate(space.periodic):
        widths = [(1, 1) if a == axis else (0, 0) for a in range(d)]
        number = np.pad(number, widths, mode="wrap") if wraps else np.pad(number, widths, constant_values=-1)
    centre = number[(slice(1, -1),) * d].ravel()
    where, rows, cols = [], [], []
    for o, start in enumerate(product((0, 1, 2), repeat=d)):
        neighbour = number[tuple(slice(s, s + n) for s, n in zip(start, shape, strict=True))].ravel()
        both = np.flatnonzero((centre >= 0) & (neighbour >= 0))
        where.append(o * centre.size + both)
        rows.append(centre[both])
        cols.append(neighbour[both])
    return np.concatenate(where), np.concatenate(rows), np.concatenate(cols)


def _bisect(space: GridSpace) -> Parts:
    """Cut across lines of nodes or two (planes in 3D), at the median of the longest side."""
    x = np.stack(np.nonzero(space.free))
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
        low, high = np.full((parts, d), np.iinfo(int).max), np.full((parts, d), -1)
        for axis in range(d):
            np.minimum.at(low[:, axis], q, x[axis])
            np.maximum.at(high[:, axis], q, x[axis])
        longest = np.argmax(high - low, axis=1)
        along = x[longest[q], np.arange(left.size)]
        lowest, extent = low[np.arange(parts), longest], int(np.max(high - low)) + 1
        sizes = np.bincount(q * extent + along - lowest[q], minlength=parts * extent).reshape(parts, extent)
        cut = lowest + np.argmax(np.cumsum(sizes, axis=1) > counts[:, None] // 2, axis=1)
        separates = along == cut[q]
        if d == 2:  # two lines of an even number leave equal halves, and batches without padding
            even = (high - low)[np.arange(parts), longest] % 2 == 1
            separates |= even[q] & (along == cut[q] - 1)
        if depth == 0:  # what is cut once more here is no longer periodic
            separates |= np.any(x[list(space.periodic)] == 0, axis=0)
        level[left[separates]], part[left[separates]] = depth, q[separates]
        stays = ~separates
        q = (2 * q + (along > cut[q]))[stays]
        left, x = left[stays], x[:, stays]
        depth += 1
