"""What surfaces and solid meshes have in common: vertices in space, simplices, and a metric on each of them."""

from typing import Any, TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.checks import real_array
from hks_jax.describe import describe_array
from hks_jax.domain import spd
from hks_jax.domain.mesh_tensors import metric_of_tensors
from hks_jax.domain.simplices import WORDS, check_metric, check_places, checked_cells, checked_mask
from hks_jax.domain.tensor_checks import Interpolation, MetricChoice, checked_tensors
from hks_jax.domain.triangulation import Triangulation
from hks_jax.static_array import StaticArray
from hks_jax.traced import is_traced


class SimplicialMesh(eqx.Module):
    """A mesh of triangles (`SurfaceMesh`) or tetrahedra (`TetMesh`) in space, with a constant metric on each."""

    vertices: Float[Array, "V 3"]
    triangulation: Triangulation = eqx.field(static=True)
    _mask: StaticArray | None = eqx.field(static=True)
    _metric: Float[Array, "n d d"] | None

    def __init__(self, vertices: Any, cells: Any, metric: Any, dimension: int, mask: Any) -> None:
        positions = real_array("vertices", vertices)
        if positions.ndim != 2 or positions.shape[1] != 3:
            raise ValueError(f"vertices: got shape {positions.shape}; expected (V, 3)")
        cells = checked_cells(cells, len(positions), dimension, mask is not None)
        self._mask = None if mask is None else StaticArray(checked_mask(mask, cells, len(positions), dimension))
        triangulation = Triangulation(self.restrict(cells), len(positions))
        if not is_traced(positions):
            check_places(np.asarray(positions, dtype=np.float64), triangulation)
        self.vertices = positions
        self.triangulation = triangulation
        self._metric = None if metric is None else _checked_metric(self.restrict(metric), triangulation)
        if metric is None and not is_traced(positions):
            check_metric(np.asarray(self.metric), np.asarray(positions, np.float64), triangulation.cells)

    def __repr__(self) -> str:
        """Return one line: the sizes, and where the metric comes from."""
        metric = "that of space" if self._metric is None else describe_array(self._metric)
        cells = f"{len(self.triangulation.cells)} {WORDS[self.triangulation.dimension].simplices}"
        return f"{type(self).__name__}(vertices {describe_array(self.vertices)}, {cells}, metric {metric})"

    def restrict(self, of_cells: Any) -> Any:
        """Return what belongs to the cells inside the mask, of an array (n, …) over all cells that were given."""
        if self._mask is None or np.shape(of_cells)[:1] != self._mask.value.shape:
            return of_cells
        return (np.asarray(of_cells) if isinstance(of_cells, list | tuple) else of_cells)[self._mask.value]

    @property
    def metric(self) -> Float[Array, "n d d"]:
        """The metric of each cell in the basis of its edges v₁ − v₀, v₂ − v₀ …; NaN if not positive definite."""
        given, edges = self._metric, self._edges
        induced = jnp.einsum("nxa,nxb->nab", edges, edges, precision="highest") if given is None else given
        return spd.positive_or_nan(induced)

    @property
    def _edges(self) -> Float[Array, "n 3 d"]:
        """The edges v₁ − v₀, v₂ − v₀ … of each cell, as columns; NaN for inverted tetrahedra."""
        corners = self.vertices[self.triangulation.cells]
        return self._oriented(jnp.swapaxes(corners[:, 1:] - corners[:, :1], -1, -2))

    def _oriented(self, frames: Float[Array, "*n 3 d"]) -> Float[Array, "*n 3 d"]:
        """Return frames ∂x/∂ξ of cells; NaN in place of those that turn tetrahedra inside out."""
        if self.triangulation.dimension == 2:
            return frames
        positive = jnp.linalg.det(frames) > 0
        return frames * jnp.where(positive, 1, jnp.nan).astype(frames.dtype)[..., None, None]


Mesh = TypeVar("Mesh", bound=SimplicialMesh)


def with_tensors(
    mesh: Mesh, tensors: Any, metric: MetricChoice | None, at: str | None, interpolation: Interpolation
) -> Mesh:
    """Return a mesh with the metric of tensors in space; see `SurfaceMesh.from_tensors`, `TetMesh.from_tensors`."""
    metric_tensors = metric_of_tensors(
        mesh._edges, mesh.triangulation, mesh.restrict(tensors), metric, at, interpolation
    )
    given = _checked_metric(metric_tensors, mesh.triangulation)  # such as an inverse that overflows
    return eqx.tree_at(lambda m: m._metric, mesh, given, is_leaf=lambda leaf: leaf is None)


def _checked_metric(metric: Any, triangulation: Triangulation) -> Float[Array, "n d d"]:
    d, n = triangulation.dimension, len(triangulation.cells)
    words = WORDS[d]
    expected = f"({words.letter}, {d}, {d}) = {(n, d, d)}, one per {words.simplex}"
    return spd.symmetrise(checked_tensors("metric", metric, np.ones(n, dtype=bool), d, expected, place=words.one))
