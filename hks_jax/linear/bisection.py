"""Recursive bisection of any graph, for nested dissection: where to cut, and which vertices separate the halves.

Distances in the graph from a few landmarks far apart serve as coordinates; every part is cut across its principal axis
at the median, and separated by a minimum vertex cover of the edges that are cut (Kőnig's theorem). All parts of a level
are cut at once.

I. S. Duff and others, Direct Methods for Sparse Matrices (2nd edition, Oxford 2017), chapters 8 and 9.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components, maximum_bipartite_matching

_CELL = 50
"""The number of vertices from which on a cell is divided further: solves take less time than with half as many."""
_LANDMARKS = 8
_SMOOTHING = 6
"""How often distances are averaged with those of neighbours: they are integers, of which many are equal. Measured on
random closed surfaces, the factors are then as large as where the vertices' positions serve as coordinates, and 3 to
8 % larger than with the cuts of METIS, which take about as long; a factorisation takes 12 to 28 % more operations."""


class Parts(NamedTuple):
    """A recursive bisection of a graph: part q of a level is separated into parts 2q and 2q + 1 of the next.

    Attributes:
        level: (n,) at which level each vertex belongs to a separator; what is separated no further, the cells, is the
            last level.
        part: (n,) the part of that level which it separates.
        depth: the number of levels.
    """

    level: Int[np.ndarray, " n"]
    part: Int[np.ndarray, " n"]
    depth: int


def bisect_graph(n: int, rows: Int[np.ndarray, " m"], cols: Int[np.ndarray, " m"]) -> Parts:
    """Bisect the graph of n vertices whose edges (row, column) are given in both directions, in the order of rows."""
    off = rows != cols
    rows, cols = rows[off], cols[off]
    x = _coordinates(n, rows, cols)
    level, part = np.full(n, -1), np.zeros(n, int)
    left, q, depth = np.arange(n), np.zeros(n, int), 0
    while True:
        counts = np.bincount(q, minlength=1 << depth)
        if counts.max() <= _CELL:
            level[left], part[left] = depth, q
            return Parts(level, part, depth + 1)
        half = _halves(x[:, left], q, counts)
        side = np.full(n, -1)
        side[left] = 2 * q + half
        crossing = (side[rows] ^ side[cols] == 1) & (side[rows] % 2 == 0)  # each edge once
        separators = minimum_cover(rows[crossing], cols[crossing])
        level[separators], part[separators] = depth, side[separators] // 2
        within = (side[rows] == side[cols]) & (level[rows] < 0) & (level[cols] < 0)
        rows, cols = rows[within], cols[within]
        left = left[level[left] < 0]
        q, depth = side[left], depth + 1


def _coordinates(n: int, rows: Int[np.ndarray, " m"], cols: Int[np.ndarray, " m"]) -> Float[np.ndarray, "c n"]:
    """Return distances from landmarks, one in each component; components lie one after the other on an axis of their
    own."""
    start = np.append(0, np.cumsum(np.bincount(rows, minlength=n)))
    graph = csr_matrix((np.ones(cols.size, np.int8), cols, start), shape=(n, n))
    count, label = connected_components(graph, directed=False)
    nearest, distances = np.zeros(n, int), []
    for number in range(_LANDMARKS + 1):
        order = np.lexsort((nearest, label))  # the last of each component is farthest from the landmarks so far
        roots = order[np.append(np.flatnonzero(np.diff(label[order])), n - 1)]
        distance = _distances(graph, roots)
        # The first search, from anywhere, only shows where the ends are.
        nearest = np.minimum(nearest, distance) if number > 1 else distance
        distances += [distance] * (number > 0)
    before = np.cumsum(np.bincount(label)) - np.bincount(label)
    apart = (before[label] * (4 * (1 + max(int(d.max()) for d in distances)))) if count > 1 else np.zeros(n, int)
    x = np.stack([*distances, apart]).astype(float)
    degree = np.maximum(np.diff(start), 1)
    for _ in range(_SMOOTHING):
        x = (x + (graph @ x.T).T / degree) / 2
    return x


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


def _halves(
    x: Float[np.ndarray, "c n"], q: Int[np.ndarray, " n"], counts: Int[np.ndarray, " parts"]
) -> Int[np.ndarray, " n"]:
    """Return 0 or 1 for each vertex: on which side of its part's median, along the part's principal axis."""
    parts = counts.size
    mean = np.stack([np.bincount(q, row, parts) for row in x]) / np.maximum(counts, 1)
    x = x - mean[:, q]
    moments = np.stack([[np.bincount(q, a * b, parts) for b in x] for a in x])
    axis = np.linalg.eigh(np.moveaxis(moments, -1, 0))[1][:, :, -1]
    order = np.lexsort((np.einsum("cn,nc->n", x, axis[q]), q))
    half = np.empty(q.size, int)
    half[order] = within_groups(counts) >= counts[q[order]] // 2
    return half


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
