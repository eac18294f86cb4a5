"""Recursive bisection of a general graph by vertex separators, for nested dissection.

Graph distances from a few landmarks, vertices far from each other, serve as coordinates of the vertices. Each part of
the graph is cut at the median along the principal axis of its coordinates. The separator is a minimum vertex cover of
the cut edges (Kőnig's theorem). All parts of one recursion level are cut by the same array operations.

I. S. Duff and others, Direct Methods for Sparse Matrices (2nd edition, Oxford 2017), chapters 8 and 9.
"""

from itertools import combinations_with_replacement
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import (
    breadth_first_order,
    connected_components,
    maximum_bipartite_matching,
    reverse_cuthill_mckee,
)

_CELL = 50
"""The largest number of vertices of a cell, which is not divided. With cells of 25 vertices, solves take longer."""
_LANDMARKS = 8
_SMOOTHING = 6
"""The number of times that each vertex's distances are averaged with its neighbours' distances, because many integer
distances are equal. On random closed surfaces, the factors have as many entries as if vertex positions were the
coordinates. Compared with METIS, whose nested dissection takes about as long, the factors have 3 to 8 % more entries,
and the factorisation takes 12 to 28 % more operations."""


Ints = Int[np.ndarray, " _"]


class Parts(NamedTuple):
    """A recursive bisection of a graph: part q of a level is divided into parts 2q and 2q + 1 of the next level."""

    # for each vertex, the level of the separator that contains it; for vertices of cells, the last level
    level: Int[np.ndarray, " n"]
    part: Int[np.ndarray, " n"]  # for each vertex, the number q of the part whose separator or cell contains it
    depth: int  # the number of levels


def bisect_graph(n: int, rows: Int[np.ndarray, " m"], cols: Int[np.ndarray, " m"]) -> Parts:
    """Bisect the graph of n vertices whose edges (row, column) are given in both directions, in the order of rows."""
    off = rows != cols
    banded, graph = _banded(n, rows[off], cols[off])
    tails, heads = np.repeat(np.arange(n, dtype=np.int32), np.diff(graph.indptr)), graph.indices
    once = tails < heads
    tails, heads = tails[once], heads[once]
    level, part, side = np.full(n, -1), np.zeros(n, int), np.empty(n, np.int32)
    # Vertices that are in no separator yet are grouped by part; each part is sorted along its parent's principal axis.
    left, x, counts, depth = np.arange(n), _coordinates(graph), np.array([n]), 0
    while True:
        q = np.repeat(np.arange(counts.size), counts)
        if counts.max() <= _CELL:
            level[left], part[left] = depth, q
            place = np.argsort(banded)
            return Parts(level[place], part[place], depth + 1)
        order = _along_axes(x, q, counts)
        left, x = left[order], x[order]
        side[left] = 2 * q + (within_groups(counts) >= counts[q] // 2)
        at_tails, at_heads = side[tails], side[heads]
        crossing = at_tails ^ at_heads == 1
        ends, swapped = np.stack([tails[crossing], heads[crossing]]), at_tails[crossing] % 2 == 1
        separators = minimum_cover(*np.where(swapped, ends[::-1], ends))
        level[separators], part[separators] = depth, side[separators] // 2
        side[separators] = -1
        at_tails, at_heads = side[tails], side[heads]
        within = (at_tails == at_heads) & (at_tails >= 0)
        tails, heads = tails[within], heads[within]
        stay = side[left] >= 0
        left, x = left[stay], x[stay]
        counts, depth = np.bincount(side[left], minlength=2 * counts.size), depth + 1


def _banded(n: int, rows: Ints, cols: Ints) -> tuple[Ints, csr_matrix]:
    """Return an order of the vertices with small bandwidth, for memory locality, and the reordered graph."""
    start = np.append(0, np.cumsum(np.bincount(rows, minlength=n)))
    graph = csr_matrix((np.ones(cols.size, np.int8), cols, start), shape=(n, n))
    order = reverse_cuthill_mckee(graph, symmetric_mode=True)
    graph = graph[order][:, order]
    graph.sort_indices()
    return order, graph


# In a disconnected graph, an additional coordinate places the connected components one after another, with gaps as long
# as the components. With longer gaps between components, a single isolated vertex would determine the principal axis.
def _coordinates(graph: csr_matrix) -> Float[np.ndarray, "n c"]:
    """Return coordinates of each vertex: averaged graph distances from the landmarks of its component."""
    n = graph.shape[0]
    count, label = connected_components(graph, directed=False)
    # The first landmark of each component is its first vertex in the reverse Cuthill–McKee order, a peripheral vertex.
    nearest, roots = np.arange(2 * n, n, -1), np.empty(count, int)
    distances: list[Int[np.ndarray, " n"]] = []
    for _ in range(_LANDMARKS):
        ends = np.flatnonzero(nearest == _largest(nearest, label, count)[label])
        roots[label[ends]] = ends  # in each component, a vertex farthest from the landmarks so far
        distances.append(_distances(graph, roots))
        nearest = np.minimum(nearest, distances[-1])
    x = np.stack(distances, axis=1).astype(np.float32)
    if count > 1:
        lengths = 1 + _largest(distances[0], label, count)
        x = np.column_stack([x, 2.0 * (np.cumsum(lengths) - lengths)[label]])
    degree = np.maximum(np.diff(graph.indptr), 1)[:, None].astype(x.dtype)
    for _ in range(_SMOOTHING):
        x = (x + graph @ x / degree) / 2
    return x


def _largest(values: Int[np.ndarray, " n"], label: Int[np.ndarray, " n"], count: int) -> Int[np.ndarray, " count"]:
    largest = np.zeros(count, int)
    np.maximum.at(largest, label, values)
    return largest


def _distances(graph: csr_matrix, roots: Int[np.ndarray, " r"]) -> Int[np.ndarray, " n"]:
    """Return graph distances to the nearest root, by one search from an additional vertex joined to all roots."""
    n = graph.shape[0]
    indices = np.append(graph.indices, roots)
    start = np.append(graph.indptr, indices.size)
    joined = csr_matrix((np.ones(indices.size, np.int8), indices, start), shape=(n + 1, n + 1))
    order, predecessor = breadth_first_order(joined, n)
    place = np.empty(n + 1, int)
    place[order] = np.arange(order.size)
    parents = place[predecessor[order[1:]]]  # ascending, because the search uses a queue
    ends = [1]
    while ends[-1] < order.size:
        ends.append(1 + int(np.searchsorted(parents, ends[-1])))
    distance = np.empty(n + 1, int)
    distance[order] = np.repeat(np.arange(len(ends)), np.diff(ends, prepend=0))
    return distance[:n] - 1


def _along_axes(x: Float[np.ndarray, "n c"], q: Ints, counts: Ints) -> Ints:
    """Return the permutation that groups vertices by part, and sorts each part along its principal axis."""
    c, parts = x.shape[1], counts.size
    mean = np.stack([np.bincount(q, column, parts) for column in x.T], axis=1) / np.maximum(counts, 1)[:, None]
    centred = np.ascontiguousarray((x - np.repeat(mean.astype(x.dtype), counts, axis=0)).T)
    moments = np.empty((parts, c, c))
    for i, j in combinations_with_replacement(range(c), 2):
        moments[:, i, j] = moments[:, j, i] = np.bincount(q, centred[i] * centred[j], parts)
    axis = np.linalg.eigh(moments)[1][:, :, -1].astype(x.dtype)
    along = np.einsum("nc,nc->n", x, np.repeat(axis, counts, axis=0))
    along -= along.min()
    return np.argsort(q + along / (1.0 + 2 * along.max()))


def within_groups(counts: Int[np.ndarray, " groups"]) -> Int[np.ndarray, " n"]:
    """Return each element's index within its group, for consecutive groups of these sizes."""
    return np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)


# Kőnig's theorem: for a maximum matching, consider alternating paths (an unmatched edge, a matched edge, …) from the
# unmatched left vertices. The left vertices that these paths do not reach, and the right vertices that they reach, form
# a vertex cover. Since this vertex cover has as many vertices as the matching has edges, no cover is smaller.
def minimum_cover(left: Int[np.ndarray, " m"], right: Int[np.ndarray, " m"]) -> Int[np.ndarray, " s"]:
    """Return a minimum vertex cover of a bipartite graph, given the left and right ends of its edges."""
    lefts, row = np.unique(left, return_inverse=True)
    rights, col = np.unique(right, return_inverse=True)
    graph = csr_matrix((np.ones(row.size, np.int8), (row, col)), shape=(lefts.size, rights.size))
    matched = maximum_bipartite_matching(graph, perm_type="column")
    back = np.full(rights.size, -1)
    back[matched[matched >= 0]] = np.flatnonzero(matched >= 0)
    reached, reached_right = matched < 0, np.zeros(rights.size, bool)
    new = np.flatnonzero(reached)
    while new.size:
        counts = np.diff(graph.indptr)[new]
        neighbours = graph.indices[np.repeat(graph.indptr[new], counts) + within_groups(counts)]
        neighbours = np.unique(neighbours[~reached_right[neighbours]])
        reached_right[neighbours] = True
        new = back[neighbours]
        new = new[~reached[new]]
        reached[new] = True
    return np.concatenate([lefts[~reached], rights[reached_right]])
