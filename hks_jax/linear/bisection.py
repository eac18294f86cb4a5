"""Recursive bisection of any graph, for nested dissection: where to cut, and which vertices separate the halves.

Distances in the graph from a few landmarks far apart serve as coordinates; every part is cut across its principal axis
at the median, and separated by a minimum vertex cover of the edges that are cut (Kőnig's theorem). All parts of a level
are cut at once.

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
"""The number of vertices from which on a cell is divided further: solves take less time than with half as many."""
_LANDMARKS = 8
_SMOOTHING = 6
"""How often distances are averaged with those of neighbours: they are integers, of which many are equal. Measured on
random closed surfaces, the factors are then as large as where the vertices' positions serve as coordinates, and 3 to
8 % larger than with the cuts of METIS, whose own nested dissection takes about as long; a factorisation takes 12 to
28 % more operations."""


Ints = Int[np.ndarray, " _"]


class Parts(NamedTuple):
    """A recursive bisection of a graph: part q of a level is separated into parts 2q and 2q + 1 of the next."""

    # at which level each vertex belongs to a separator; what is separated no further, the cells, is the last level
    level: Int[np.ndarray, " n"]
    part: Int[np.ndarray, " n"]  # the part of that level which it separates
    depth: int  # the number of levels


def bisect_graph(n: int, rows: Int[np.ndarray, " m"], cols: Int[np.ndarray, " m"]) -> Parts:
    """Bisect the graph of n vertices whose edges (row, column) are given in both directions, in the order of rows."""
    off = rows != cols
    banded, graph = _banded(n, rows[off], cols[off])
    tails, heads = np.repeat(np.arange(n, dtype=np.int32), np.diff(graph.indptr)), graph.indices
    once = tails < heads
    tails, heads = tails[once], heads[once]
    level, part, side = np.full(n, -1), np.zeros(n, int), np.empty(n, np.int32)
    # The vertices that are left, those of a part together, along the axis across which it was cut out.
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
    """Return an order of the vertices in which neighbours are near each other, in memory too, and the graph in it."""
    start = np.append(0, np.cumsum(np.bincount(rows, minlength=n)))
    graph = csr_matrix((np.ones(cols.size, np.int8), cols, start), shape=(n, n))
    order = reverse_cuthill_mckee(graph, symmetric_mode=True)
    graph = graph[order][:, order]
    graph.sort_indices()
    return order, graph


# The gaps between components are as long as these are: with longer ones, one vertex of its own would turn the principal
# axis of all others towards it.
def _coordinates(graph: csr_matrix) -> Float[np.ndarray, "n c"]:
    """Return distances from landmarks, one in each component; components follow each other on an axis of their own."""
    n = graph.shape[0]
    count, label = connected_components(graph, directed=False)
    # The first in the order is far from the last; no distance is as large.
    nearest, roots = np.arange(2 * n, n, -1), np.empty(count, int)
    distances: list[Int[np.ndarray, " n"]] = []
    for _ in range(_LANDMARKS):
        ends = np.flatnonzero(nearest == _largest(nearest, label, count)[label])
        roots[label[ends]] = ends  # one in each component, as far as can be from the landmarks so far
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
    """Return the largest of each component's values, which are not negative."""
    largest = np.zeros(count, int)
    np.maximum.at(largest, label, values)
    return largest


def _distances(graph: csr_matrix, roots: Int[np.ndarray, " r"]) -> Int[np.ndarray, " n"]:
    """Return the number of edges to the nearest root, by one search from a further vertex that leads to all of them."""
    n = graph.shape[0]
    indices = np.append(graph.indices, roots)
    start = np.append(graph.indptr, indices.size)
    joined = csr_matrix((np.ones(indices.size, np.int8), indices, start), shape=(n + 1, n + 1))
    order, predecessor = breadth_first_order(joined, n)
    place = np.empty(n + 1, int)
    place[order] = np.arange(order.size)
    parents = place[predecessor[order[1:]]]  # ascending, as in any queue
    ends = [1]
    while ends[-1] < order.size:
        ends.append(1 + int(np.searchsorted(parents, ends[-1])))
    distance = np.empty(n + 1, int)
    distance[order] = np.repeat(np.arange(len(ends)), np.diff(ends, prepend=0))
    return distance[:n] - 1


def _along_axes(x: Float[np.ndarray, "n c"], q: Ints, counts: Ints) -> Ints:
    """Return an order in which the vertices of each part, which lie together, follow its principal axis."""
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
    """Return 0, 1, … within each of consecutive groups."""
    return np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)


# Kőnig: let Z be what alternating paths (an edge that is not matched, an edge that is, …) reach from the unmatched
# vertices of the one side, for a maximum matching. The vertices of that side outside Z and those of the other in Z
# cover all edges, and are as many as the matching has edges: no cover has fewer.
def minimum_cover(left: Int[np.ndarray, " m"], right: Int[np.ndarray, " m"]) -> Int[np.ndarray, " s"]:
    """Return a minimum vertex cover of a bipartite graph, given by the two ends of its edges."""
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
