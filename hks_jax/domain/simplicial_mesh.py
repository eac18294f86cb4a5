"""Meshes in space with a metric on each simplex: surfaces of triangles, and solids of tetrahedra."""

from typing import Any, ClassVar, Literal, TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from hks_jax.arrays import StaticArray, describe_array
from hks_jax.checks import real_array
from hks_jax.compilation import library_of, numpy_where_known
from hks_jax.domain import spd
from hks_jax.domain.simplices import WORDS, check_metric, check_places, checked_cells, checked_mask
from hks_jax.domain.tensor_checks import (
    Interpolation,
    MetricChoice,
    OperatorChoice,
    checked_interpolation,
    of_diffusion,
    require_finite_symmetric,
    require_spd,
)
from hks_jax.domain.triangulation import Triangulation
from hks_jax.linear.products import matmul
from hks_jax.traced import is_traced

Mesh = TypeVar("Mesh", bound="SimplicialMesh")


class SimplicialMesh(eqx.Module):
    """A mesh of triangles (`SurfaceMesh`) or tetrahedra (`TetMesh`) in space, with a constant metric on each cell.

    The operator is that of the metric, or Fick's if `from_tensors` was told so.
    """

    vertices: Float[Array, "V 3"]
    triangulation: Triangulation = eqx.field(static=True)
    _mask: StaticArray | None = eqx.field(static=True)
    operator: OperatorChoice = eqx.field(static=True)
    _metric: Float[Array, "n d d"] | None
    _dimension: ClassVar[int]

    def __init__(self, vertices: Any, cells: Any, metric: Any = None, mask: Any = None) -> None:
        positions = real_array("vertices", vertices)
        if positions.ndim != 2 or positions.shape[1] != 3:
            raise ValueError(f"vertices: got shape {positions.shape}; expected (V, 3)")
        cells = checked_cells(cells, len(positions), self._dimension, mask is not None)
        inside = None if mask is None else checked_mask(mask, cells, len(positions), self._dimension)
        self._mask = None if inside is None else StaticArray(inside)
        self.vertices, self.operator = positions, "laplace-beltrami"
        self.triangulation = triangulation = Triangulation(self.restrict(cells), len(positions))
        if not is_traced(positions):
            check_places(np.asarray(positions, np.float64), triangulation, whole=mask is None)
        self._metric = None if metric is None else _checked_metric(self.restrict(metric), triangulation)
        if metric is None and not is_traced(positions):
            check_metric(np.asarray(self.metric), np.asarray(positions), triangulation.cells)

    @classmethod
    def from_tensors(
        cls: type[Mesh],
        vertices: Any,
        cells: Any,
        tensors: Any,
        metric: MetricChoice | None = None,
        *,
        operator: OperatorChoice = "laplace-beltrami",
        at: Literal["faces", "cells", "vertices"] | None = None,
        interpolation: Interpolation = "linear",
        mask: Any = None,
    ) -> Mesh:
        """Return the mesh with a metric or with Fick's operator made of tensors D in space.

        A surface uses only the tangential parts of the tensors.

        The tangential part of D is its quadratic form on the plane of a triangle. If D is a diffusion tensor, its
        tangential part describes diffusion within the surface. The choice has no default (see
        `TensorField.from_diffusion`): the metric ``"tensor"``, g = D; ``"inverse"``, g = D⁻¹; or ``"adjugate"``, g =
        |D| D⁻¹; or no metric and ``operator="fick"``, which is div(D∇u) with the area or volume of space. On a surface,
        D in these formulas is the tangential part. If D is the identity, g is the Euclidean metric.

        Tensors at vertices are interpolated to the centre of each cell: by the mean of the tensors at its vertices, or
        with ``"log-euclidean"`` by the exponential of the mean of their logarithms. Using one tensor per cell causes an
        error of second order, as the elements do. The metric is differentiable with respect to tensors and vertices.

        Args:
            vertices: positions (V, 3).
            cells: vertex indices of the triangles (F, 3) or tetrahedra (C, 4).
            tensors: one symmetric tensor per cell, (F, 3, 3) or (C, 3, 3), or per vertex, (V, 3, 3). The tensors must
                be positive definite; on a surface, only their tangential parts must be.
            metric: ``"inverse"``, ``"tensor"`` or ``"adjugate"``.
            operator: ``"laplace-beltrami"`` of the metric, or ``"fick"``.
            at: whether the tensors belong to ``"faces"`` (of a surface), ``"cells"`` (of a solid) or ``"vertices"``;
                needed only if there are as many cells as vertices.
            interpolation: ``"linear"`` or ``"log-euclidean"``, for tensors at vertices; see `TensorField`.
            mask: the domain, as for the class; tensors outside are ignored.

        Raises:
            ValueError: an unknown metric, operator or interpolation; wrong shapes; tensors that are NaN, infinite,
                unsymmetric or not positive definite (with their number and the first place); the errors that the class
                raises.
        """
        mesh = cls(vertices, cells, mask=mask)
        metric = of_diffusion(metric, operator)
        object.__setattr__(mesh, "operator", operator)
        checked_interpolation(interpolation)
        edges, triangulation = mesh._edges, mesh.triangulation
        # The place is known from the shape before cells are removed: afterwards there may be as many as vertices.
        all_cells = len(triangulation.cells) if mesh._mask is None else mesh._mask.value.size
        array = real_array("tensors", tensors)
        at_vertices = _place(array.shape, triangulation, at, all_cells) == "vertices"
        array = array if at_vertices else mesh.restrict(array)
        if not is_traced((array, edges)):
            _check_tensors(np.asarray(array), np.asarray(edges), triangulation, at_vertices)
        corners = triangulation.cells if at_vertices else np.arange(len(array))[:, None]
        of_cells = _tangential_metric(
            edges, spd.symmetrise(array), corners, metric, interpolation if at_vertices else "linear"
        )
        given = _checked_metric(of_cells, triangulation)  # inverting the tensors may overflow
        return eqx.tree_at(lambda m: m._metric, mesh, given, is_leaf=lambda leaf: leaf is None)

    def __repr__(self) -> str:
        metric = "that of space" if self._metric is None else describe_array(self._metric)
        cells = f"{len(self.triangulation.cells)} {WORDS[self.triangulation.dimension].simplices}"
        operator = "" if self.operator == "laplace-beltrami" else f", operator={self.operator!r}"
        return f"{type(self).__name__}(vertices {describe_array(self.vertices)}, {cells}, metric {metric}{operator})"

    def restrict(self, of_cells: Any) -> Any:
        """Remove the entries of cells outside the mask from an array (n, …), unless they are already removed."""
        if self._mask is None or np.shape(of_cells)[:1] != self._mask.value.shape:
            return of_cells
        return (np.asarray(of_cells) if isinstance(of_cells, list | tuple) else of_cells)[self._mask.value]

    @property
    def metric(self) -> Float[Array, "n d d"]:
        """The metric of each cell in the basis of its edges v₁ − v₀, v₂ − v₀ …; NaN if not positive definite."""
        # The symmetric part is taken here, as in `TensorField.tensors`, because the leaf may change.
        given = self._metric
        return _induced_metric(self._edges) if given is None else spd.positive_or_nan(spd.symmetrise(given))

    @property
    def metric_of_space(self) -> Float[Array, "n d d"] | None:
        """The metric of space in the basis of `metric`, if the mesh has another metric."""
        return None if self._metric is None else _induced_metric(self._edges)

    @property
    def _edges(self) -> Float[Array, "n 3 d"]:
        """The edges v₁ − v₀, v₂ − v₀ … of each cell, as columns; NaN for inverted tetrahedra."""
        return _edges_of(self.vertices, self.triangulation.cells)


class SurfaceMesh(SimplicialMesh):
    """A triangle mesh in space, with the metric that space induces on it, or with a given metric.

    A mesh is a pytree: its leaves are the vertex positions and the given metric, if any. The connectivity is static.

    Args:
        vertices: positions (V, 3).
        faces: vertex indices (F, 3).
        metric: (F, 2, 2), the metric of triangles in the basis of edges v₁ − v₀ and v₂ − v₀, in place of the induced
            metric.
        mask: bool, True inside the domain: (F,) for the triangles, or (V,) for the vertices. A triangle is inside if
            all its vertices are inside. Triangles outside may be degenerate or NaN. The rim of the mask belongs to the
            boundary, results are NaN at vertices outside, and ``faces`` has only the triangles inside.

    Raises:
        ValueError: wrong shapes; a mask without triangles; indices out of range; vertices without a face; triangles
            without area; NaN; a metric that is not positive definite.

    Examples:
        >>> triangle = hj.SurfaceMesh(np.eye(3), [[0, 1, 2]])
        >>> print(triangle.metric[0].tolist())  # the products of two edges of length √2
        [[2.0, 1.0], [1.0, 2.0]]
    """

    _dimension = 2

    def __init__(self, vertices: Any, faces: Any, metric: Any = None, mask: Any = None) -> None:
        super().__init__(vertices, faces, metric, mask)

    @property
    def faces(self) -> Int[np.ndarray, "F 3"]:
        """Vertex indices, one row per triangle."""
        return self.triangulation.cells


class TetMesh(SimplicialMesh):
    """A mesh of tetrahedra, with the Euclidean metric or with a given metric that is constant on each tetrahedron.

    A mesh is a pytree: its leaves are the vertex positions and the given metric, if any. The connectivity is static.

    Tetrahedra must be positively oriented, (v₁ − v₀) × (v₂ − v₀) · (v₃ − v₀) > 0, as in VTK and Gmsh. An inverted
    tetrahedron, for example after moving a vertex, raises an error, or gives NaN under `jit`.

    Args:
        vertices: positions (V, 3).
        cells: vertex indices (C, 4).
        metric: (C, 3, 3), the metric of each tetrahedron in the basis of its edges v₁ − v₀, v₂ − v₀ and v₃ − v₀, in
            place of the Euclidean metric. For tensors with components along the coordinate axes see `from_tensors`.
        mask: bool, (C,) for the tetrahedra or (V,) for the vertices, as for `SurfaceMesh`.

    Raises:
        ValueError: wrong shapes; a mask without tetrahedra; indices out of range; vertices without a cell; NaN; a
            metric that is not positive definite; tetrahedra that have no volume, are inverted, or overlap across a
            common triangle (with their number and the first one).

    Examples:
        >>> corner = hj.TetMesh(np.vstack([np.zeros(3), np.eye(3)]), [[0, 1, 2, 3]])
        >>> print(jnp.linalg.det(corner.metric))  # (6 · volume)²
        [1.]
    """

    _dimension = 3

    def __init__(self, vertices: Any, cells: Any, metric: Any = None, mask: Any = None) -> None:
        super().__init__(vertices, cells, metric, mask)

    @property
    def cells(self) -> Int[np.ndarray, "C 4"]:
        """Vertex indices, one row per tetrahedron."""
        return self.triangulation.cells

    def boundary(self) -> tuple[SurfaceMesh, Int[np.ndarray, " B"]]:
        """Return the surface of the triangles that belong to only one tetrahedron, with the metric induced by space.

        Returns:
            The surface, oriented outward, and the indices (B,) of its vertices in this mesh. If ``numbers`` are the
            indices, an array ``values`` (…, V) on this mesh is ``values[..., numbers]`` on the surface.
        """
        triangulation = self.triangulation
        numbers, faces = np.unique(triangulation.facet_vertices(triangulation.boundary_facets), return_inverse=True)
        return SurfaceMesh(self.vertices[numbers], faces.reshape(-1, 3)), numbers


def _checked_metric(metric: Any, triangulation: Triangulation) -> Float[Array, "n d d"]:
    d, n, array = triangulation.dimension, len(triangulation.cells), real_array("metric", metric)
    words = WORDS[d]
    if array.shape != (n, d, d):
        expected = f"({words.letter}, {d}, {d}) = {(n, d, d)}, one per {words.simplex}"
        raise ValueError(f"metric: got shape {array.shape}; expected {expected}")
    if not is_traced(array):
        require_spd("metric", np.asarray(array), np.ones(n, dtype=bool), words.one)
    return array


@numpy_where_known(static_argnums=(3, 4))
def _tangential_metric(
    edges: Any, tensors: Any, corners: Any, metric: MetricChoice, interpolation: Interpolation
) -> Any:
    """Return the metric of cells in the basis of their edges (n, 3, d), from tensors in space at corners (n, c)."""
    xp = library_of(edges)
    frames = _orthonormal(edges)
    parts = matmul(frames.mT[:, None], tensors[corners], frames[:, None])
    # The tensors at all vertices of a cell, and not only their mean, must be positive definite.
    parts = spd.nan_unless_positive(parts)
    # The logarithm of the tangential part is used, because the tensor in space may be indefinite.
    mean = xp.mean(parts, axis=1) if interpolation == "linear" else spd.exp(jnp.mean(spd.log(parts), axis=1))
    coordinates = matmul(frames.mT, edges)
    return matmul(coordinates.mT, spd.metric_of_diffusion(mean, metric), coordinates)


@numpy_where_known()
def _edges_of(vertices: Any, cells: Any) -> Any:
    """Return the edges v₁ − v₀, v₂ − v₀ … of each cell, as columns; NaN for inverted tetrahedra."""
    corners = vertices[cells]
    return oriented((corners[:, 1:] - corners[:, :1]).mT)


@numpy_where_known()
def _induced_metric(edges: Any) -> Any:
    return spd.nan_unless_positive(matmul(edges.mT, edges))


def oriented(frames: Any) -> Any:
    """Return the Jacobian matrices ∂x/∂ξ (..., 3, d) of cells, with NaN for inverted tetrahedra."""
    return frames if frames.shape[-1] == 2 else spd.nan_unless(spd.determinant(frames) > 0, frames)


def _orthonormal(edges: Any) -> Any:
    """Return an orthonormal basis, as columns, of the plane of each triangle (by Gram–Schmidt) or of space."""
    xp = library_of(edges)
    if edges.shape[-1] == 3:
        return xp.broadcast_to(xp.eye(3, dtype=edges.dtype), edges.shape)
    first, second = edges[..., 0], edges[..., 1]
    first = first / xp.linalg.norm(first, axis=-1, keepdims=True)
    second = second - xp.sum(first * second, axis=-1, keepdims=True) * first
    return xp.stack([first, second / xp.linalg.norm(second, axis=-1, keepdims=True)], axis=-1)


def _place(shape: tuple[int, ...], triangulation: Triangulation, at: str | None, all_cells: int) -> str:
    """Return whether tensors of this shape belong to the vertices or to the cells (the faces of a surface).

    Tensors of cells are those of all cells, or only of the cells inside a mask.
    """
    words = WORDS[triangulation.dimension]
    of_cells = all_cells if shape[:1] == (all_cells,) else len(triangulation.cells)
    counts = {words.argument: of_cells, "vertices": triangulation.n_vertices}
    if at not in (None, *counts):
        raise ValueError(f'at: got {at!r}; expected "{words.argument}", "vertices" or None')
    fitting = [place for place, n in counts.items() if shape == (n, 3, 3) and at in (None, place)]
    if len(fitting) == 1:
        return fitting[0]
    if fitting:
        raise ValueError(
            f"at: the mesh has as many {words.argument} as vertices, {shape[0]}, and tensors of shape {shape} may "
            f'belong to either; pass at="{words.argument}" or at="vertices"'
        )
    one = {words.argument: words.one, "vertices": "vertex"}
    expected = [f"({n}, 3, 3), one per {one[place]}" for place, n in counts.items() if at in (None, place)]
    raise ValueError(f"tensors: got shape {shape}; expected {', or '.join(expected)}")


def _check_tensors(
    tensors: Float[np.ndarray, "m 3 3"],
    edges: Float[np.ndarray, "n 3 d"],
    triangulation: Triangulation,
    at_vertices: bool,
) -> None:
    """Raise ValueError unless the tensors are finite, symmetric, and positive definite on the cells that use them."""
    words = WORDS[triangulation.dimension]
    everywhere = triangulation.used if at_vertices else np.ones(len(tensors), dtype=bool)
    place = "vertex" if at_vertices else words.one
    if triangulation.dimension == 3:
        return require_spd("tensors", tensors, everywhere, place)
    require_finite_symmetric("tensors", tensors, everywhere, place)
    # In an orthonormal basis the eigenvalues do not depend on the shape of the triangle.
    frames = np.linalg.qr(edges.astype(np.float64))[0]
    owners = triangulation.cells if at_vertices else np.arange(len(tensors))[:, None]
    parts = np.einsum("nxa,nixy,nyb->niab", frames, tensors[owners], frames)
    least = np.linalg.eigvalsh(parts)[..., 0]
    bad = least <= np.finfo(tensors.dtype).eps * np.abs(tensors).max(axis=(1, 2))[owners]
    if bad.any():
        which = np.unique(owners[bad])
        raise ValueError(
            f"tensors: {which.size} of {len(tensors)} tensors are not positive definite on "
            f"{'the faces around them' if at_vertices else 'their face'} (the first at {place} {which[0]}), "
            f"worst eigenvalue {least[bad].min():.3g}; expected tensors whose tangential part is "
            "symmetric positive definite. Raise their eigenvalues, or check that tensors and vertices have one basis"
        )
