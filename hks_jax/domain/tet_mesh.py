"""A solid in space, cut into tetrahedra."""

from typing import Any, Literal

import numpy as np
from jaxtyping import Int

from hks_jax.domain.simplicial_mesh import SimplicialMesh, with_tensors
from hks_jax.domain.surface_mesh import SurfaceMesh
from hks_jax.domain.tensor_checks import Interpolation, MetricChoice


class TetMesh(SimplicialMesh):
    """A mesh of tetrahedra, with the metric of space, or another that is constant on each of them.

    A pytree: the vertex positions and the given metric, if any, are its leaves, the connectivity is structure.

    Tetrahedra are positively oriented, (v₁ − v₀) × (v₂ − v₀) · (v₃ − v₀) > 0, as VTK and Gmsh have them: so one that a
    moved vertex has turned inside out is noticed. Under `jit`, where it cannot be refused, it gives NaN.

    Args:
        vertices: positions (V, 3).
        cells: vertex indices (C, 4).
        metric: (C, 3, 3), the metric of each tetrahedron in the basis of its edges v₁ − v₀, v₂ − v₀ and v₃ − v₀, in
            place of that of space. For tensors in the axes of space see `from_tensors`.
        mask: the domain, bool, True inside: of the tetrahedra (C,), or of the vertices (V,), where it consists of
            the tetrahedra all of whose vertices are inside. What lies outside may be degenerate or NaN. The rim of the
            mask belongs to the boundary, results are NaN at vertices outside, and ``cells`` are those inside.

    Raises:
        ValueError: wrong shapes, a mask that leaves nothing, indices out of range, vertices without a cell, NaN, a
            metric that is not positive definite; tetrahedra that have no volume, are inverted, or overlap across a
            common triangle (with how many, and which is the first).
    """

    def __init__(self, vertices: Any, cells: Any, metric: Any = None, mask: Any = None) -> None:
        super().__init__(vertices, cells, metric, dimension=3, mask=mask)

    @classmethod
    def from_tensors(
        cls,
        vertices: Any,
        cells: Any,
        tensors: Any,
        metric: MetricChoice | None = None,
        *,
        at: Literal["cells", "vertices"] | None = None,
        interpolation: Interpolation = "linear",
        mask: Any = None,
    ) -> "TetMesh":
        """Return the mesh with the metric of a field of tensors D in the axes of space.

        What metric g they stand for has no default (see `TensorField.from_diffusion`): ``"tensor"``, g = D;
        ``"inverse"``, g = D⁻¹; ``"adjugate"``, g = |D| D⁻¹.

        Of tensors at the vertices a tetrahedron takes the mean of its four, or with ``"log-euclidean"`` that of their
        logarithms, as either interpolation does at its centre: an error of second order, as that of the elements.
        Differentiable with respect to tensors and vertices.

        Args:
            vertices: positions (V, 3).
            cells: vertex indices (C, 4).
            tensors: (C, 3, 3) or (V, 3, 3), symmetric positive definite.
            metric: ``"inverse"``, ``"tensor"`` or ``"adjugate"``.
            at: whether the tensors belong to ``"cells"`` or ``"vertices"``; None: their number tells, unless C = V.
            interpolation: ``"linear"`` or ``"log-euclidean"``, see `TensorField`; for tensors at vertices.
            mask: the domain, see the class; tensors outside are ignored.

        Raises:
            ValueError: a metric or interpolation that is none of these; wrong shapes; tensors that are NaN or infinite,
                unsymmetric or not positive definite (with how many, and where the first is); what `TetMesh` raises.
        """
        return with_tensors(cls(vertices, cells, mask=mask), tensors, metric, at, interpolation)

    @property
    def cells(self) -> Int[np.ndarray, "C 4"]:
        """Vertex indices, one row per tetrahedron."""
        return self.triangulation.cells

    def boundary(self) -> tuple[SurfaceMesh, Int[np.ndarray, " B"]]:
        """Return the triangles that belong to one tetrahedron only, with the metric of space, oriented outward.

        Returns:
            The surface, and for each of its B vertices the number that it has in this mesh: values (…, V) on the
            boundary are ``values[..., numbers]``.
        """
        triangulation = self.triangulation
        numbers, faces = np.unique(triangulation.facet_vertices(triangulation.boundary_facets), return_inverse=True)
        return SurfaceMesh(self.vertices[numbers], faces.reshape(-1, 3)), numbers
