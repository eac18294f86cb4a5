"""The connectivity of a triangle mesh."""

from functools import cached_property

import jax
import numpy as np
from jaxtyping import Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from hks_jax.domain.static_array import StaticArray


@jax.tree_util.register_static
class Triangulation:
    """The connectivity of a triangle mesh: static, hashable."""

    def __init__(self, faces: Int[np.ndarray, "F 3"], n_vertices: int) -> None:
        self._faces = StaticArray(faces, dtype=np.int64)
        self.n_vertices = n_vertices

    @property
    def faces(self) -> Int[np.ndarray, "F 3"]:
        """Vertex indices, one row per triangle."""
        return self._faces.value

    @cached_property
    def boundary_vertices(self) -> np.ndarray:
        """The vertices on edges that belong to one triangle only, bool (V,)."""
        edges = np.sort(self.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        unique, counts = np.unique(edges, axis=0, return_counts=True)
        on_boundary = np.zeros(self.n_vertices, dtype=bool)
        on_boundary[unique[counts == 1].ravel()] = True
        return on_boundary

    @cached_property
    def labels(self) -> tuple[np.ndarray, int]:
        """The connected component of each vertex (1 … n), and their number n."""
        rows, cols = self.faces[:, [0, 1]].ravel(), self.faces[:, [1, 2]].ravel()
        graph = coo_matrix((np.ones(rows.size), (rows, cols)), shape=(self.n_vertices,) * 2)
        count, labels = connected_components(graph, directed=False)
        return labels + 1, int(count)

    def __eq__(self, other: object) -> bool:
        return self is other or (
            isinstance(other, Triangulation) and self.n_vertices == other.n_vertices and self._faces == other._faces
        )

    def __hash__(self) -> int:
        return hash((self.n_vertices, self._faces))
