"""A triangulated surface in space."""

from functools import cached_property
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from hks_jax.domain import spd
from hks_jax.domain.static_array import StaticArray
from hks_jax.domain.tensor_field import checked_tensors
from hks_jax.traced import is_traced


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


class SurfaceMesh(eqx.Module):
    """A triangle mesh in space, with the metric that space induces on it, or another.

    A pytree: the vertex positions and the given metric, if any, are its leaves, the connectivity is structure.

    Args:
        vertices: positions (V, 3).
        faces: vertex indices (F, 3).
        metric: (F, 2, 2), the metric of each triangle in the basis of its edges v₁ − v₀ and v₂ − v₀, in place of the
            induced one.

    Raises:
        ValueError: wrong shapes, indices out of range, vertices without a face, triangles without area, NaN, a metric
            that is not positive definite.
    """

    vertices: Float[Array, "V 3"]
    triangulation: Triangulation = eqx.field(static=True)
    _metric: Float[Array, "F 2 2"] | None

    def __init__(self, vertices: Any, faces: Any, metric: Any = None) -> None:
        positions = jnp.asarray(vertices)
        if not jnp.issubdtype(positions.dtype, jnp.floating):
            positions = positions.astype(jnp.result_type(float))
        indices = np.asarray(faces)
        if positions.ndim != 2 or positions.shape[1] != 3:
            raise ValueError(f"vertices: got shape {positions.shape}; expected (V, 3)")
        if indices.ndim != 2 or indices.shape[1] != 3 or not np.issubdtype(indices.dtype, np.integer):
            raise ValueError(
                f"faces: got shape {indices.shape}, dtype {indices.dtype}; expected integers of shape (F, 3)"
            )
        n = positions.shape[0]
        if indices.size == 0 or indices.min() < 0 or indices.max() >= n:
            span = f"{indices.min()} … {indices.max()}" if indices.size else "no faces"
            raise ValueError(f"faces: got vertex indices {span}; expected 0 … {n - 1}, as there are {n} vertices")
        unused = n - np.unique(indices).size
        if unused:
            raise ValueError(f"vertices: {unused} of {n} belong to no face; remove them")
        if not is_traced(positions):
            _check_triangles(np.asarray(positions, dtype=np.float64), indices)
        self.vertices = positions
        self.triangulation = Triangulation(indices, n)
        self._metric = None if metric is None else _checked_metric(metric, len(indices))

    @property
    def metric(self) -> Float[Array, "F 2 2"]:
        """The metric of each triangle in the basis of its edges v₁ − v₀ and v₂ − v₀."""
        if self._metric is not None:
            return self._metric
        corners = self.vertices[self.faces]
        edges = jnp.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=-1)
        return jnp.einsum("fxa,fxb->fab", edges, edges, precision="highest")

    @property
    def faces(self) -> Int[np.ndarray, "F 3"]:
        """Vertex indices, one row per triangle."""
        return self.triangulation.faces


def _checked_metric(metric: Any, n_faces: int) -> Float[Array, "F 2 2"]:
    expected = f"(F, 2, 2) = {(n_faces, 2, 2)}, one per triangle"
    return spd.symmetrise(checked_tensors("metric", metric, np.ones(n_faces, dtype=bool), 2, expected, place="face"))


def _check_triangles(vertices: np.ndarray, faces: np.ndarray) -> None:
    if not np.isfinite(vertices).all():
        raise ValueError(f"vertices: {int((~np.isfinite(vertices)).any(1).sum())} are NaN or infinite; remove them")
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    longest = np.max([np.sum((p - q) ** 2, axis=1) for p, q in ((a, b), (b, c), (c, a))], axis=0)
    flat = area <= 1e-10 * longest
    if flat.any():
        raise ValueError(
            f"faces: {int(flat.sum())} of {len(faces)} triangles have no area (the first is face "
            f"{int(np.argmax(flat))}); remove or merge them"
        )
