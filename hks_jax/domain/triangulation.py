"""The connectivity of a mesh of simplices: triangles or tetrahedra."""

from functools import cached_property
from itertools import combinations

import jax
import numpy as np
from jaxtyping import Bool, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from hks_jax.arrays import ByKey, StaticArray

FACETS = {
    2: np.array([[1, 2], [2, 0], [0, 1]]),
    3: np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]]),
}
"""The facets of a triangle (key 2) or a tetrahedron (key 3): row i has the corners of the facet opposite corner i. The
facets of a positively oriented simplex are oriented outward."""


@jax.tree_util.register_static
class Triangulation(ByKey):
    """The connectivity of a mesh of triangles or tetrahedra, static and hashable.

    Facets are the edges of triangles, or the triangles of tetrahedra. In dimension d, the facet opposite corner i of
    cell c has the number (d + 1) c + i, so a facet between two cells has two numbers, one from each cell.
    """

    def __init__(self, cells: Int[np.ndarray, "n corners"], n_vertices: int) -> None:
        self._cells = StaticArray(cells, dtype=np.int64)
        self.n_vertices = n_vertices
        self._key = n_vertices, self._cells

    @property
    def cells(self) -> Int[np.ndarray, "n corners"]:
        """Vertex indices, one row per triangle or tetrahedron."""
        return self._cells.value

    @property
    def dimension(self) -> int:
        """2 for triangles, 3 for tetrahedra."""
        return self.cells.shape[1] - 1

    def facet_vertices(self, facets: Int[np.ndarray, " m"]) -> Int[np.ndarray, "m d"]:
        """Return the vertices of facets."""
        cell, corner = np.divmod(facets, self.dimension + 1)
        return self.cells[cell[:, None], FACETS[self.dimension][corner]]

    @cached_property
    def _grouped_facets(self) -> tuple[Int[np.ndarray, " n"], Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
        """Facet numbers, sorted by vertices; whether each begins a new facet; whether its vertices are in odd order."""
        vertices = self.facet_vertices(np.arange(self.cells.size))
        odd = np.zeros(len(vertices), dtype=bool)
        for a, b in combinations(range(self.dimension), 2):
            odd ^= vertices[:, a] > vertices[:, b]
        vertices = np.sort(vertices, axis=1)
        order = np.lexsort(vertices.T[::-1])
        begins = np.ones(order.size, dtype=bool)
        begins[1:] = (vertices[order[1:]] != vertices[order[:-1]]).any(axis=1)
        return order, begins, odd[order]

    @cached_property
    def boundary_facets(self) -> Int[np.ndarray, " m"]:
        """The facets that belong to only one cell, in ascending order."""
        order, begins, _ = self._grouped_facets
        return np.sort(order[begins & np.append(begins[1:], True)])

    @cached_property
    def overlaps(self) -> Int[np.ndarray, "m 2"]:
        """Pairs of cells that lie on the same side of a common facet if all cells are positively oriented.

        If three or more cells share a facet, two of them lie on the same side.
        """
        order, begins, odd = self._grouped_facets
        again = np.flatnonzero(~begins)
        again = again[(odd[again] == odd[again - 1]) | ~begins[again - 1]]
        return np.stack([order[again - 1], order[again]], axis=1) // (self.dimension + 1)

    @cached_property
    def crowded_facets(self) -> Int[np.ndarray, " m"]:
        """The facets that belong to three or more cells, each given by one of its numbers."""
        order, begins, _ = self._grouped_facets
        starts = np.flatnonzero(begins)
        return order[starts[np.diff(np.append(starts, order.size)) > 2]]

    @cached_property
    def pinched_vertices(self) -> Int[np.ndarray, " m"]:
        """The vertices whose cells form several groups that touch only there: cells of a group are joined by facets.

        In a solid whose cells do not overlap, these vertices are on the boundary; others are not examined.
        """
        order, begins, _ = self._grouped_facets
        d, vertices = self.dimension, self.cells.ravel()
        known = np.ones(vertices.size, bool) if d == 2 else self.boundary_vertices[vertices]
        # The graph has a node for each corner of each cell, and an edge between equal corners of adjacent cells.
        again, ends = np.flatnonzero(~begins), []
        if d == 3:
            again = again[self.boundary_vertices[self.facet_vertices(order[again])].any(axis=1)]
        for facet in (order[again - 1], order[again]):
            cell, corner = np.divmod(facet, d + 1)
            corners = cell[:, None] * (d + 1) + FACETS[d][corner]
            ends.append(np.take_along_axis(corners, np.argsort(vertices[corners], axis=1), axis=1).ravel())
        rows, cols = ends
        kept, number = known[rows], np.cumsum(known) - 1
        edges = number[rows[kept]], number[cols[kept]]
        graph = coo_matrix((np.ones(len(edges[0]), np.int8), edges), shape=(int(known.sum()),) * 2)
        count, group = connected_components(graph, directed=False)
        vertex_of = np.zeros(count, np.int64)
        vertex_of[group] = vertices[known]
        return np.flatnonzero(np.bincount(vertex_of, minlength=self.n_vertices) > 1)

    @cached_property
    def boundary_vertices(self) -> Bool[np.ndarray, " V"]:
        """Whether each vertex is on a facet that belongs to only one cell, bool (V,)."""
        return np.isin(np.arange(self.n_vertices), self.facet_vertices(self.boundary_facets))

    @cached_property
    def _edges(self) -> tuple[Int[np.ndarray, "E 2"], Int[np.ndarray, "n m"]]:
        pairs = list(combinations(range(self.dimension + 1), 2))
        ends = np.sort(self.cells[:, pairs], axis=-1)
        keys, numbers = np.unique(ends[..., 0] * self.n_vertices + ends[..., 1], return_inverse=True)
        return np.stack(np.divmod(keys, self.n_vertices), axis=-1), numbers.reshape(len(self.cells), len(pairs))

    @property
    def edges(self) -> Int[np.ndarray, "E 2"]:
        """The two vertices of each edge, the smaller number first; edges are in ascending order."""
        return self._edges[0]

    @property
    def cell_edges(self) -> Int[np.ndarray, "n m"]:
        """The numbers of each cell's edges: between its corners 0 and 1, 0 and 2, 0 and 3, 1 and 2, …."""
        return self._edges[1]

    @cached_property
    def boundary_edges(self) -> Bool[np.ndarray, " E"]:
        """Whether each edge is on a facet that belongs to only one cell, bool (E,)."""
        corners = self.facet_vertices(self.boundary_facets)
        ends = np.sort(corners[:, list(combinations(range(self.dimension), 2))], axis=-1).reshape(-1, 2)
        keys, own = (pairs[:, 0] * self.n_vertices + pairs[:, 1] for pairs in (self.edges, ends))
        return np.isin(keys, own)

    @cached_property
    def used(self) -> Bool[np.ndarray, " V"]:
        """Whether each vertex belongs to a cell, bool (V,). Only vertices outside a mask belong to no cell."""
        return np.isin(np.arange(self.n_vertices), self.cells)

    @cached_property
    def labels(self) -> tuple[Int[np.ndarray, " V"], int]:
        """The connected component of each vertex (1 … n, or 0 for a vertex without a cell), and the number n."""
        rows, cols = self.cells[:, :-1].ravel(), self.cells[:, 1:].ravel()
        graph = coo_matrix((np.ones(rows.size), (rows, cols)), shape=(self.n_vertices,) * 2)
        known, labels = np.unique(connected_components(graph, directed=False)[1][self.used], return_inverse=True)
        every = np.zeros(self.n_vertices, dtype=np.int64)
        every[self.used] = labels + 1
        return every, known.size

    def __repr__(self) -> str:
        return f"Triangulation({len(self.cells)} cells of dimension {self.dimension}, {self.n_vertices} vertices)"
