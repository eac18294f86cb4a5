"""A triangulated surface in space."""

from typing import Any, Literal

import numpy as np
from jaxtyping import Int

from hks_jax.domain.simplicial_mesh import SimplicialMesh, with_tensors
from hks_jax.domain.tensor_checks import Interpolation, MetricChoice


class SurfaceMesh(SimplicialMesh):
    """A triangle mesh in space, with the metric that space induces on it, or another.

    A pytree: the vertex positions and the given metric, if any, are its leaves, the connectivity is structure.

    Args:
        vertices: positions (V, 3).
        faces: vertex indices (F, 3).
        metric: (F, 2, 2), the metric of each triangle in the basis of its edges v₁ − v₀ and v₂ − v₀, in place of the
            induced one.
        mask: the domain, bool, True inside: of the triangles (F,), or of the vertices (V,), where it consists of
            the triangles all of whose vertices are inside. What lies outside may be degenerate or NaN. The rim of the
            mask belongs to the boundary, results are NaN at vertices outside, and ``faces`` are those inside.

    Raises:
        ValueError: wrong shapes, a mask that leaves nothing, indices out of range, vertices without a face, triangles
            without area, NaN, a metric that is not positive definite.
    """

    def __init__(self, vertices: Any, faces: Any, metric: Any = None, mask: Any = None) -> None:
        super().__init__(vertices, faces, metric, dimension=2, mask=mask)

    @classmethod
    def from_tensors(
        cls,
        vertices: Any,
        faces: Any,
        tensors: Any,
        metric: MetricChoice | None = None,
        *,
        at: Literal["faces", "vertices"] | None = None,
        interpolation: Interpolation = "linear",
        mask: Any = None,
    ) -> "SurfaceMesh":
        """Return the surface with the metric of a field of tensors D in space, of which the tangential part counts.

        The tangential part of D is D as a quadratic form on the vectors of a triangle's plane: for diffusion tensors,
        diffusion that stays in the surface, with the diffusivities that were measured in it. What metric g it stands
        for has no default (see `TensorField.from_diffusion`): ``"tensor"``, g is the tangential part; ``"inverse"``,
        its inverse in the plane; ``"adjugate"``, that inverse times its determinant in the plane. With D the identity
        all three are the metric that space induces.

        Of tensors at the vertices a triangle takes the tangential parts of its three, and averages them: these
        themselves, or with ``"log-euclidean"`` their logarithms in its plane, as either interpolation does at its
        centre. Differentiable with respect to tensors and vertices.

        Args:
            vertices: positions (V, 3).
            faces: vertex indices (F, 3).
            tensors: (F, 3, 3) or (V, 3, 3), symmetric, in the axes of space, positive definite on the planes of the
                faces that they act on.
            metric: ``"inverse"``, ``"tensor"`` or ``"adjugate"``.
            at: whether the tensors belong to ``"faces"`` or ``"vertices"``; None: their number tells, unless F = V.
            interpolation: ``"linear"`` or ``"log-euclidean"``, see `TensorField`; for tensors at vertices.
            mask: the domain, see the class; tensors outside are ignored.

        Raises:
            ValueError: a metric or interpolation that is none of these; wrong shapes; tensors that are NaN or infinite,
                unsymmetric or not positive definite on a face (with how many, and where the first is); what
                `SurfaceMesh` raises.
        """
        return with_tensors(cls(vertices, faces, mask=mask), tensors, metric, at, interpolation)

    @property
    def faces(self) -> Int[np.ndarray, "F 3"]:
        """Vertex indices, one row per triangle."""
        return self.triangulation.cells
