"""Tensors in space on a triangulated surface: the metric of their tangential part."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.domain import spd
from hks_jax.domain.tensor_field import MetricChoice, check_metric_choice, require_finite_symmetric
from hks_jax.domain.triangulation import Triangulation
from hks_jax.traced import is_traced

_PLACE = {"faces": "face", "vertices": "vertex"}


def tangential_metric(
    edges: Float[Array, "F 3 2"],
    triangulation: Triangulation,
    tensors: Any,
    metric: MetricChoice | None,
    at: str | None,
) -> Float[Array, "F 2 2"]:
    """Return the metric of the tensors' tangential part in the basis of each triangle's edges.

    See `SurfaceMesh.from_tensors`.
    """
    check_metric_choice(metric)
    array = jnp.asarray(tensors)
    if not jnp.issubdtype(array.dtype, jnp.floating):
        array = array.astype(jnp.result_type(float))
    at = _place(array.shape, triangulation, at)
    if not is_traced((array, edges)):
        _check(np.asarray(array), np.asarray(edges), triangulation, at)
    array = spd.symmetrise(array)
    if at == "vertices":
        array = jnp.mean(array[triangulation.faces], axis=1)

    def form(tensors: Float[Array, "F 3 3"]) -> Float[Array, "F 2 2"]:
        return jnp.einsum("fxa,fxy,fyb->fab", edges, tensors, edges, precision="highest")

    part = form(array)
    if metric == "tensor":
        return part
    # In the edges' basis the metric G of space lowers indices: of the plane's tensor with both up, G⁻¹SG⁻¹, the
    # inverse has both down, GS⁻¹G; its determinant in an orthonormal basis is |S|/|G|.
    induced = form(jnp.broadcast_to(jnp.eye(3, dtype=array.dtype), array.shape))
    scale = spd.determinant(part) if metric == "inverse" else spd.determinant(induced)
    middle = spd.adjugate(part) / scale[:, None, None]
    return jnp.einsum("fab,fbc,fcd->fad", induced, middle, induced, precision="highest")


def _place(shape: tuple[int, ...], triangulation: Triangulation, at: str | None) -> str:
    """Return whether tensors of this shape belong to the faces or the vertices."""
    counts = {"faces": len(triangulation.faces), "vertices": triangulation.n_vertices}
    if at not in (None, *counts):
        raise ValueError(f'at: got {at!r}; expected "faces", "vertices" or None')
    fitting = [place for place, n in counts.items() if shape == (n, 3, 3) and at in (None, place)]
    if len(fitting) == 1:
        return fitting[0]
    if fitting:
        raise ValueError(
            f"at: the mesh has as many faces as vertices, {shape[0]}, and tensors of shape {shape} may belong to "
            'either; say which by at="faces" or at="vertices"'
        )
    expected = [f"({n}, 3, 3), one per {_PLACE[place]}" for place, n in counts.items() if at in (None, place)]
    raise ValueError(f"tensors: got shape {shape}; expected {', or '.join(expected)}")


def _check(
    tensors: Float[np.ndarray, "n 3 3"], edges: Float[np.ndarray, "F 3 2"], triangulation: Triangulation, at: str
) -> None:
    """Raise ValueError unless the tensors are finite, symmetric, and positive definite on their faces' planes."""
    everywhere = np.ones(len(tensors), dtype=bool)
    require_finite_symmetric("tensors", tensors, everywhere, _PLACE[at], remedy="Replace them")
    # An orthonormal frame: positive definite or not, and by how much, must not depend on the triangle's shape.
    frames = np.linalg.qr(edges.astype(np.float64))[0]
    faces = np.arange(len(tensors))[:, None] if at == "faces" else triangulation.faces
    parts = np.einsum("fxa,fixy,fyb->fiab", frames, tensors[faces], frames)
    least = np.linalg.eigvalsh(parts)[..., 0]
    bad = least <= np.finfo(tensors.dtype).eps * np.abs(tensors).max(axis=(1, 2))[faces]
    if bad.any():
        owners = np.unique(faces[bad])
        raise ValueError(
            f"tensors: {owners.size} of {len(tensors)} tensors are not positive definite on "
            f"{'their face' if at == 'faces' else 'the faces around them'} (the first at {_PLACE[at]} {owners[0]}), "
            f"worst eigenvalue {least[bad].min():.3g}; expected tensors whose tangential part is "
            "symmetric positive definite. Raise their eigenvalues, or check that they are in the axes of the vertices"
        )
