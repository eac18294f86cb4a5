"""Nested dissection: an elimination order of a sparse matrix's rows, and the structure of its fronts.

A separator divides the graph of the matrix into two halves that the matrix does not couple. Each half is divided
recursively by its own separator, down to small cells. Elimination goes from the cells up to the first separator. A
front is the dense matrix block in which a separator or a cell is eliminated. All fronts of a level are independent and
of nearly equal size; padded to the largest size, they form one batch of dense blocks.

A. George, Nested dissection of a regular finite element mesh, SIAM J. Numer. Anal. 10 (1973).
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from hks_jax.linear import accelerators
from hks_jax.linear.bisection import within_groups
from hks_jax.linear.pattern import Pattern

_TRAFFIC = 20e6
"""The memory traffic in bytes that takes as long as a kernel launch: 4 µs at 4.8 TB/s."""
_LAUNCHES = 4
"""The number of kernel launches per level in a solve: a gather and a product, both upwards and downwards."""
_BYTES = 8
_ALIGNED = 64
"""Large fronts have a multiple of this number of nodes; otherwise XLA would copy their matrices to pad them."""

Ints = Int[np.ndarray, " _"]


class Level(NamedTuple):
    """The fronts of one level. A front eliminates s own nodes; r boundary nodes coupled to it are eliminated later.

    If a front has fewer nodes than the largest front, its indices are padded with the length of the indexed array.
    """

    own: Int[np.ndarray, "fronts s"]  # the eliminated degrees of freedom
    # the index of each boundary node in the flattened array (fronts, s + r) of all nodes of the level above
    boundary: Int[np.ndarray, "fronts r"]
    # the indices of each of the front's nodes in the flattened array (fronts, r) of the boundary nodes of the level
    # below. A node has at most c indices; in an elimination tree, one for each child front. Cells have an empty array
    children: Int[np.ndarray, "c fronts s_plus_r"]

    @property
    def shape(self) -> tuple[int, int, int]:
        """The shape (fronts, s + r, s) of the matrix blocks with rows of all nodes and columns of own nodes."""
        fronts, s = self.own.shape
        return fronts, s + self.boundary.shape[1], s


class Merged(NamedTuple):
    """The merged tree, which solves on accelerators use instead of the elimination tree."""

    levels: tuple[Level, ...]  # the merged levels
    order: Int[np.ndarray, " n_dof"]  # the index of each degree of freedom in the concatenated ``own`` of all levels
    # the index of each own node of a tree level in the flattened ``own`` of its merged level; out of range for padding
    rows: tuple[tuple[Int[np.ndarray, "_fronts _s"], ...], ...]
    # the index of each own node of a merged level in the joined ``own`` of its tree levels; out of range for padding
    places: tuple[Int[np.ndarray, "_fronts _s"], ...]


class Dissection(NamedTuple):
    """The elimination tree."""

    # from the first separator to the cells; level l has 2^l fronts, and front q has children 2q and 2q + 1
    levels: tuple[Level, ...]
    order: Int[np.ndarray, " n_dof"]  # the index of each degree of freedom in the concatenated ``own`` of all levels
    # the indices of the matrix entries that elimination reads, in the array of entries; None if all entries are listed
    entries: Int[np.ndarray, " m"] | None
    # the index of each listed entry in the concatenated blocks (fronts, s + r, s) of all levels. If an entry's row is
    # eliminated before the front of its column, only the transposed entry is read, and the index is out of range
    places: Int[np.ndarray, " m"]
    padding: Int[np.ndarray, " p"]  # the indices of padding's diagonal entries in the concatenated blocks
    merged: Merged | None  # the merged tree for solves on accelerators; None if solves use the elimination tree


def dissect(pattern: Pattern) -> Dissection:
    """Return the elimination tree of a matrix with this pattern.

    Raises:
        ValueError: the factors have 2³¹ or more entries.
    """
    return _dissect(pattern, accelerators.at_hand())


@lru_cache(maxsize=16)
def _dissect(pattern: Pattern, merge: bool) -> Dissection:
    entries, rows, cols = pattern.places()
    n = pattern.size
    level, front, depth = pattern.bisect()
    own, slot = _own_nodes(level, front, depth)
    # The difference of levels is positive if an entry's row is eliminated before its column, and negative if after it.
    order_of_ends = level[rows] - level[cols]
    above = np.flatnonzero(order_of_ends > 0)
    boundaries = _boundaries(level, front, depth, rows[above], cols[above])
    ranks = [within_groups(np.bincount(keys // n)) for keys in boundaries]
    # Arrays of boundary nodes have at least one column, which is padding if no front is coupled to its parent. Only on
    # the first level, whose front has no parent, arrays of boundary nodes have no columns.
    width = [int(rank.max(initial=min(number, 1) - 1)) + 1 for number, rank in enumerate(ranks)]
    # For each boundary node, find its front, and its index among the own and boundary nodes of the parent front.
    placed = [(keys // n, slot[keys % n]) for keys in boundaries]
    for below, (at, place) in enumerate(placed[1:]):
        nodes = boundaries[below + 1] % n
        inherited = level[nodes] < below
        entry = np.searchsorted(boundaries[below], at[inherited] // 2 * n + nodes[inherited])
        place[inherited] = own[below].shape[1] + ranks[below][entry]
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
        raise ValueError(
            f"matrix: got {n} rows, whose factors have {start[-1]} entries; expected fewer than 2^31. Use a coarser "
            "grid or mesh, or the Chebyshev filter, which does not factorise"
        )
    mine = np.flatnonzero(order_of_ends <= 0)
    rows, cols, eliminated = rows[mine], cols[mine], level[cols[mine]]
    place = slot[rows]
    outside = np.flatnonzero(order_of_ends[mine] < 0)
    for number in range(1, depth):
        above = outside[eliminated[outside] == number]
        key = front[cols[above]] * n + rows[above]
        place[above] = stride[number] + ranks[number][np.searchsorted(boundaries[number], key)]
    column = (start[level] + front * (height * stride)[level] + slot).astype(np.int32)
    places = column[cols] + stride.astype(np.int32)[eliminated] * place
    padding = [
        first + q * h * s + j * (s + 1)
        for first, h, s, nodes in zip(start[:-1], height, stride, own, strict=True)
        for q, j in [np.nonzero(nodes == n)]
    ]
    listed, places = _listed(entries[mine], places, pattern.n_entries, int(start[-1]))
    several = merged(tuple(levels), n) if merge else None
    return Dissection(
        tuple(levels), order[:n].astype(np.int32), listed, places, np.concatenate(padding).astype(np.int32), several
    )


def _listed(entries: Ints, places: Ints, number: int, end: int) -> tuple[Ints | None, Ints]:
    """Return ``entries`` and ``places`` of `Dissection`, with all matrix entries listed if this takes less memory."""
    others = number - entries.size
    if others > entries.size or end + others > np.iinfo(np.int32).max:
        return entries.astype(np.int32), places.astype(np.int32)
    of_all, without = np.empty(number, np.int32), np.ones(number, bool)
    of_all[entries], without[entries] = places, False
    of_all[without] = np.arange(end, end + others)  # distinct places, because the scatter declares its indices unique
    return None, of_all


def _own_nodes(level: Ints, front: Ints, depth: int) -> tuple[list[np.ndarray], Ints]:
    """Return the own nodes (fronts, s) of each level's fronts, and the index of every node in its front."""
    n, own, slot = level.size, [], np.zeros(level.size, np.int32)
    for number in range(depth):
        nodes = np.flatnonzero(level == number)
        nodes = nodes[np.argsort(front[nodes], kind="stable")]
        slot[nodes] = within_groups(np.bincount(front[nodes]))
        table = np.full((1 << number, int(slot[nodes].max(initial=0)) + 1), n)
        table[front[nodes], slot[nodes]] = nodes
        own.append(table)
    return own, slot


def _boundaries(level: Ints, front: Ints, depth: int, rows: Ints, cols: Ints) -> list[Ints]:
    """Return the boundary nodes of each level's fronts as sorted keys front·n + node.

    Boundary nodes of a front are eliminated after the front. An entry (row, column) couples a boundary node to an own
    node of the front, or the node is a boundary node of a child front.
    """
    n, keys, boundaries = level.size, np.empty(0, int), []
    eliminated, keys_of = level[rows], front[rows] * n + cols
    for number in reversed(range(depth)):
        inherited = keys // n // 2 * n + keys % n
        keys = np.sort(np.concatenate([inherited[level[keys % n] < number], keys_of[eliminated == number]]))
        keys = keys[np.append(True, keys[1:] > keys[:-1])[: keys.size]]  # far faster than np.unique, which hashes
        boundaries.append(keys)
    return boundaries[::-1]


# On accelerators, solves use a merged tree: a front and its descendants on following levels become one front with an
# explicit inverse. Merging increases memory traffic but reduces kernel launches; the groups of levels are chosen for
# the least total cost. The factorisation, which also gives the inertia, still uses the elimination tree (Alvarado,
# Pothen and Schreiber, in Graph Theory and Sparse Matrix Computation, Springer 1993).
def merged(levels: tuple[Level, ...], n: int) -> Merged:
    """Merge levels of the elimination tree of n degrees of freedom."""
    groups = divided(levels, n)
    own, rows, places = zip(*(_merged_nodes(levels[first:end], n) for first, end in groups), strict=True)
    of_levels = _boundary_nodes(levels, n)
    boundaries = [of_levels[first] for first, _ in groups]
    nodes = [np.concatenate(both, axis=1) for both in zip(own, boundaries, strict=True)]
    children, result = np.zeros((0, *nodes[-1].shape), int), []
    for number in reversed(range(len(groups))):
        fronts, r = boundaries[number].shape
        below, boundary = children, np.zeros((fronts, r), int)
        if number > 0:
            above = nodes[number - 1]
            front, slot = np.nonzero(boundaries[number] < n)
            place = _find(above, front // (fronts // len(above)), boundaries[number][front, slot], n)
            boundary[:] = above.size
            boundary[front, slot] = place
            counts, ascending = np.bincount(place, minlength=above.size), np.argsort(place, kind="stable")
            children = np.full((max(int(counts.max()), 1), above.size), fronts * r)
            children[within_groups(counts), place[ascending]] = (front * r + slot)[ascending]
            children = children.reshape(-1, *above.shape)
        result.append(Level(*(field.astype(np.int32) for field in (own[number], boundary, below))))
    order = np.empty(n + 1, np.int32)
    order[np.concatenate([nodes.ravel() for nodes in own])] = np.arange(sum(nodes.size for nodes in own))
    return Merged(tuple(result[::-1]), order[:n], rows, places)


def divided(levels: tuple[Level, ...], n: int) -> list[tuple[int, int]]:
    """Divide the levels into groups for the least cost of solves; return the first level and the end of each group."""
    depth = len(levels)
    counts = [np.sum(level.own < n, axis=1) for level in levels]
    best: list[tuple[float, int]] = [(0.0, depth)] * (depth + 1)
    for first in reversed(range(depth)):
        fronts, sizes, ways = 1 << first, np.zeros(1 << first, int), []
        r = levels[first].boundary.shape[1]
        for end in range(first + 1, depth + 1):
            sizes += counts[end - 1].reshape(fronts, -1).sum(axis=1)
            s = int(sizes.max())
            traffic = _BYTES * float(fronts) * s * (s + 2 * r)
            ways.append((traffic / _TRAFFIC + _LAUNCHES + best[end][0], end))
        best[first] = min(ways)
    groups, first = [], 0
    while first < depth:
        groups.append((first, best[first][1]))
        first = best[first][1]
    return groups


def _merged_nodes(levels: tuple[Level, ...], n: int) -> tuple[np.ndarray, tuple[np.ndarray, ...], np.ndarray]:
    """Return the own nodes of the merged fronts, and the ``rows`` and ``places`` of `Merged` for one level."""
    fronts = len(levels[0].own)
    sizes = np.array([level.own.size for level in levels])
    start = np.cumsum(sizes) - sizes
    nodes = np.concatenate([level.own.reshape(fronts, -1) for level in levels], axis=1)
    where = np.concatenate(
        [(at + np.arange(size)).reshape(fronts, -1) for at, size in zip(start, sizes, strict=True)], axis=1
    )
    last = np.argsort(nodes == n, axis=1, kind="stable")  # padding comes last
    s = int(np.sum(nodes < n, axis=1).max(initial=1))
    s = min(s if s < _ALIGNED else -(-s // _ALIGNED) * _ALIGNED, nodes.shape[1])
    own = np.take_along_axis(nodes, last, axis=1)[:, :s]
    places = np.take_along_axis(where, last, axis=1)[:, :s]
    row = np.full(sizes.sum(), fronts * s, np.int32)
    row[places[own < n]] = np.flatnonzero(own < n)
    rows = tuple(
        row[at : at + level.own.size].reshape(level.own.shape) for at, level in zip(start, levels, strict=True)
    )
    return own, rows, np.where(own < n, places, row.size).astype(np.int32)


def _boundary_nodes(levels: tuple[Level, ...], n: int) -> list[np.ndarray]:
    """Return the degrees of freedom at the boundary of each level's fronts, padded with n."""
    nodes, result = np.empty(0, int), []
    for level in levels:
        boundary = np.append(nodes, n)[np.minimum(level.boundary, nodes.size)]
        nodes = np.concatenate([level.own, boundary], axis=1).ravel()
        result.append(boundary)
    return result


def _find(nodes: np.ndarray, front: np.ndarray, node: np.ndarray, n: int) -> np.ndarray:
    """Return, for each pair (front, node), the flat index of ``node`` in row ``front`` of the array ``nodes``."""
    keys = (np.arange(len(nodes))[:, None] * (n + 1) + nodes).ravel()
    ascending = np.argsort(keys, kind="stable")
    return ascending[np.searchsorted(keys, front * (n + 1) + node, sorter=ascending)]
