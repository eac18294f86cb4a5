"""A triangulated surface in space."""

from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from hks_jax.domain import spd
from hks_jax.domain.surface_tensors import tangential_metric
from hks_jax.domain.tensor_field import MetricChoice, checked_tensors
from hks_jax.domain.triangulation import Triangulation
from hks_jax.traced import is_traced


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

    @classmethod
    def from_tensors(
        cls,
        vertices: Any,
        faces: Any,
        tensors: Any,
        metric: MetricChoice | None = None,
        *,
        at: Literal["faces", "vertices"] | None = None,
    ) -> "SurfaceMesh":
        """Return the surface with the metric of a field of tensors D in space, of which the tangential part counts.

        The tangential part of D is D as a quadratic form on the vectors of a triangle's plane: for diffusion tensors,
        diffusion that stays in the surface, with the diffusivities that were measured in it. What metric g it stands
        for has no default (see `TensorField.from_diffusion`): ``"tensor"``, g is the tangential part; ``"inverse"``,
        its inverse in the plane; ``"adjugate"``, that inverse times its determinant in the plane. With D the identity
        all three are the metric that space induces.

        Tensors at the vertices are averaged, plainly, over the three of each triangle: so does linear interpolation at
        its centre, and tensors that are tangential themselves, without an inverse, have a mean too. Differentiable
        with respect to tensors and vertices.

        Args:
            vertices: positions (V, 3).
            faces: vertex indices (F, 3).
            tensors: (F, 3, 3) or (V, 3, 3), symmetric, in the axes of space, positive definite on the planes of the
                faces that they act on.
            metric: ``"inverse"``, ``"tensor"`` or ``"adjugate"``.
            at: whether the tensors belong to ``"faces"`` or ``"vertices"``; None: their number tells, unless F = V.

        Raises:
            ValueError: a metric that is none of these; wrong shapes; tensors that are NaN or infinite, unsymmetric or
                not positive definite on a face (with how many, and where the first is); what `SurfaceMesh` raises.
        """
        mesh = cls(vertices, faces)
        return cls(mesh.vertices, mesh.faces, tangential_metric(mesh._edges, mesh.triangulation, tensors, metric, at))

    @property
    def metric(self) -> Float[Array, "F 2 2"]:
        """The metric of each triangle in the basis of its edges v₁ − v₀ and v₂ − v₀."""
        if self._metric is not None:
            return self._metric
        return jnp.einsum("fxa,fxb->fab", self._edges, self._edges, precision="highest")

    @property
    def _edges(self) -> Float[Array, "F 3 2"]:
        """The edges v₁ − v₀ and v₂ − v₀ of each triangle, as columns."""
        corners = self.vertices[self.faces]
        return jnp.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=-1)

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
