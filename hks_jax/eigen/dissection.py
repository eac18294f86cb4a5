"""Nested dissection of a grid: in which order to eliminate its nodes, and what each elimination touches.

A line of nodes or two (a plane in 3D) separates a grid into two halves that the stencil does not couple; lines separate
the halves, and so on down to small cells. Eliminated from the cells up to the first separator, all fronts of a level
are independent and nearly of one size: padded to the largest, a level is one batch of dense blocks.

A. George, Nested dissection of a regular finite element mesh, SIAM J. Numer. Anal. 10 (1973).
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from hks_jax.fem.operators import stencil_pattern
from hks_jax.fem.space import GridSpace

_CELL = {2: 25, 3: 64}
"""The number of nodes from which on a cell is divided further: fewer operations against more, smaller batches."""


class Level(NamedTuple):
    """The fronts of one level: each eliminates its own s nodes, and is coupled to r boundary nodes eliminated later.

    Where a front has fewer, indices are padded with the first number that is out of range.

    Attributes:
        own: (fronts, s) the degrees of freedom eliminated.
        boundary: (fronts, r) the places of the boundary nodes among the (fronts, s + r) nodes of the level above.
        children: (2, fronts, s + r) the places of the front's nodes among the (fronts, r) boundary nodes of the level
            below: those of the first child, and those of the second. Empty for cells.
    """

    own: Int[np.ndarray, "fronts s"]
    boundary: Int[np.ndarray, "fronts r"]
    children: Int[np.ndarray, "two fronts s_plus_r"]

    @property
    def shape(self) -> tuple[int, int, int]:
        """(fronts, s + r, s): that of the blocks which hold the columns of the own nodes."""
        fronts, s = self.own.shape
        return fronts, s + self.boundary.shape[1], s


class Dissection(NamedTuple):
    """The elimination tree.

    Attributes:
        levels: from the first separator to the cells; level l has 2^l fronts, and front q has children 2q and 2q + 1.
        order: (n_dof,) the place of each degree of freedom among the levels' own nodes, concatenated.
        entries: (m,) the matrix entries, as indices into the stencil's coefficients.
        places: (m,) their places among all levels' blocks (fronts, s + r, s), concatenated: those of an entry's column,
            unless its row is eliminated before.
        padding: (p,) the places of the diagonal entries that belong to no node.
    """

    levels: tuple[Level, ...]
    order: Int[np.ndarray, " n_dof"]
    entries: Int[np.ndarray, " m"]
    places: Int[np.ndarray, " m"]
    padding: Int[np.ndarray, " p"]


@lru_cache(maxsize=16)
def dissect(space: GridSpace) -> Dissection:
    """Return the elimination tree of the grid's degrees of freedom."""
    entries, (rows, cols) = stencil_pattern(space)
    n = space.n_dof
    level, front, depth = _bisect(space)
    own, slot = _own_nodes(level, front, depth)
    boundaries = _boundaries(level, front, depth, rows, cols)
    ranks = [_rank(keys // n, nodes.shape[0]) for keys, nodes in zip(boundaries, own, strict=True)]
    width = [int(rank.max(initial=-1)) + 1 for rank in ranks]
    # For each boundary node of a level, its front and its place in the parent: among its own nodes, or its boundary.
    placed = [(keys // n, slot[keys % n]) for keys in boundaries]
    for below, (at, place) in enumerate(placed[1:]):
        nodes = boundaries[below + 1] % n
        inherited = level[nodes] < below
        found = np.searchsorted(boundaries[below], at[inherited] // 2 * n + nodes[inherited])
        place[inherited] = own[below].shape[1] + ranks[below][found]
    levels = []
    for number, (nodes, rank, r) in enumerate(zip(own, ranks, width, strict=True)):
        fronts, s = nodes.shape
        boundary, children = np.zeros((fronts, r), int), np.zeros((2, fronts, 0), int)
        if number > 0:
            at, place = placed[number]
            size = own[number - 1].shape[1] + width[number - 1]
            boundary = np.full((fronts, r), fronts // 2 * size)
            boundary[at, rank] = at // 2 * size + place
        if number < depth - 1:
            at, place = placed[number + 1]
            children = np.full((2, fronts, s + r), 2 * fronts * width[number + 1])
            children[at % 2, at // 2, place] = at * width[number + 1] + ranks[number + 1]
        levels.append(Level(*(field.astype(np.int32) for field in (nodes, boundary, children))))
    order = np.empty(n + 1, int)
    order[np.concatenate([nodes.ravel() for nodes in own])] = np.arange(sum(nodes.size for nodes in own))

    _, height, stride = shapes = np.array([level.shape for level in levels]).T
    start = np.append(0, np.cumsum(np.prod(shapes, axis=0)))
    if start[-1] > np.iinfo(np.int32).max:
        raise ValueError(f"grid: got {n} nodes; expected fewer, whose factorisation has less than 2^31 entries")
    mine = np.flatnonzero(level[rows] <= level[cols])
    rows, cols = rows[mine], cols[mine]
    place = slot[rows]
    outside = np.flatnonzero(level[rows] < level[cols])
    eliminated = level[cols[outside]]
    for number in range(1, depth):
        above = outside[eliminated == number]
        key = front[cols[above]] * n + rows[above]
        place[above] = stride[number] + ranks[number][np.searchsorted(boundaries[number], key)]
    column = (start[level] + front * (height * stride)[level] + slot).astype(np.int32)
    places = column[cols] + stride.astype(np.int32)[level[cols]] * place
    padding = [
        first + q * h * s + j * (s + 1)
        for first, h, s, nodes in zip(start[:-1], height, stride, own, strict=True)
        for q, j in [np.nonzero(nodes == n)]
    ]
    fields = order[:n], entries[mine], places, np.concatenate(padding)
    return Dissection(tuple(levels), *(field.astype(np.int32) for field in fields))


def _bisect(space: GridSpace) -> tuple[np.ndarray, np.ndarray, int]:
    """Return the level and the front of every degree of freedom, and the number of levels."""
    x = np.stack(np.nonzero(space.free))
    d, n = x.shape
    level, front, left, q = np.zeros(n, np.int8), np.zeros(n, int), np.arange(n), np.zeros(n, int)
    depth = 0
    while True:
        fronts = 1 << depth
        counts = np.bincount(q, minlength=fronts)
        if counts.max() <= _CELL[d]:
            level[left], front[left] = depth, q
            return level, front, depth + 1
        # Cut every part across its longest side, at the median.
        low, high = np.full((fronts, d), np.iinfo(int).max), np.full((fronts, d), -1)
        for axis in range(d):
            np.minimum.at(low[:, axis], q, x[axis])
            np.maximum.at(high[:, axis], q, x[axis])
        longest = np.argmax(high - low, axis=1)
        along = x[longest[q], np.arange(left.size)]
        lowest, extent = low[np.arange(fronts), longest], int(np.max(high - low)) + 1
        sizes = np.bincount(q * extent + along - lowest[q], minlength=fronts * extent).reshape(fronts, extent)
        cut = lowest + np.argmax(np.cumsum(sizes, axis=1) > counts[:, None] // 2, axis=1)
        separates = along == cut[q]
        if d == 2:  # two lines of an even number leave equal halves, and batches without padding
            even = (high - low)[np.arange(fronts), longest] % 2 == 1
            separates |= even[q] & (along == cut[q] - 1)
        if depth == 0:  # what is cut once more here is no longer periodic
            separates |= np.any(x[list(space.periodic)] == 0, axis=0)
        level[left[separates]], front[left[separates]] = depth, q[separates]
        stays = ~separates
        q = (2 * q + (along > cut[q]))[stays]
        left, x = left[stays], x[:, stays]
        depth += 1


def _own_nodes(level: np.ndarray, front: np.ndarray, depth: int) -> tuple[list[np.ndarray], np.ndarray]:
    """Return for each level the nodes of its fronts, (fronts, s), and the place of every node in its front."""
    n, own, slot = level.size, [], np.zeros(level.size, np.int32)
    for number in range(depth):
        nodes = np.flatnonzero(level == number)
        nodes = nodes[np.argsort(front[nodes], kind="stable")]
        slot[nodes] = _rank(front[nodes], 1 << number)
        table = np.full((1 << number, int(slot[nodes].max(initial=0)) + 1), n)
        table[front[nodes], slot[nodes]] = nodes
        own.append(table)
    return own, slot


def _boundaries(
    level: np.ndarray, front: np.ndarray, depth: int, rows: np.ndarray, cols: np.ndarray
) -> list[np.ndarray]:
    """Return for each level the boundary nodes of its fronts as sorted keys front·n + node.

    They are what the front's own nodes are coupled to above it, and what it inherits from its children's boundaries.
    """
    n, keys, found = level.size, np.empty(0, int), []
    above = level[cols] < level[rows]
    rows, cols = rows[above], cols[above]
    for number in reversed(range(depth)):
        inherited = keys // n // 2 * n + keys % n
        here = level[rows] == number
        keys = np.sort(np.concatenate([inherited[level[keys % n] < number], front[rows[here]] * n + cols[here]]))
        keys = keys[np.append(True, keys[1:] > keys[:-1])[: keys.size]]  # np.unique hashes, which takes far longer
        found.append(keys)
    return found[::-1]


def _rank(groups: np.ndarray, count: int) -> np.ndarray:
    """Return the place of each element within its group; the groups are sorted."""
    sizes = np.bincount(groups, minlength=count)
    return np.arange(groups.size) - (np.cumsum(sizes) - sizes)[groups]
