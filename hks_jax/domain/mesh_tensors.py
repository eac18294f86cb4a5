"""The metric of each cell of a mesh from tensors in the axes of space."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.checks import real_array
from hks_jax.domain import spd
from hks_jax.domain.simplices import WORDS
from hks_jax.domain.tensor_checks import (
    Interpolation,
    MetricChoice,
    check_metric_choice,
    checked_interpolation,
    require_finite_symmetric,
    require_spd,
)
from hks_jax.domain.triangulation import Triangulation
from hks_jax.traced import is_traced


def metric_of_tensors(
    edges: Float[Array, "n 3 d"],
    triangulation: Triangulation,
    tensors: Any,
    metric: MetricChoice | None,
    at: str | None,
    interpolation: Interpolation,
) -> Float[Array, "n d d"]:
    """Return the metric of tensors in space, in the basis of each cell's edges; triangles take the tangential part.

    See `SurfaceMesh.from_tensors` and `TetMesh.from_tensors`.
    """
    check_metric_choice(metric)
    checked_interpolation(interpolation)
    array = real_array("tensors", tensors)
    at = _place(array.shape, triangulation, at)
    at_vertices = at == "vertices"
    if not is_traced((array, edges)):
        _check(np.asarray(array), np.asarray(edges), triangulation, at_vertices)
    corners = triangulation.cells if at_vertices else np.arange(len(array))[:, None]
    frames = _orthonormal(edges)
    parts = jnp.einsum("nxa,ncxy,nyb->ncab", frames, spd.symmetrise(array)[corners], frames, precision="highest")
    # The tensors at all vertices of a cell, and not only their mean, must be positive definite.
    parts = spd.positive_or_nan(parts)
    # The logarithm is that of the tangential part, since tensors may be indefinite across a surface.
    if interpolation == "linear" or not at_vertices:
        part = jnp.mean(parts, axis=1)
    else:
        part = spd.exp(jnp.mean(spd.log(parts), axis=1))
    if metric != "tensor":
        part = spd.inverse(part) if metric == "inverse" else spd.adjugate(part)
    coordinates = jnp.einsum("nxa,nxb->nab", frames, edges, precision="highest")
    return jnp.einsum("nab,nac,ncd->nbd", coordinates, part, coordinates, precision="highest")


def _orthonormal(edges: Float[Array, "n 3 d"]) -> Float[Array, "n 3 d"]:
    """Return an orthonormal basis, as columns, of each triangle's plane by Gram–Schmidt, or of space."""
    if edges.shape[-1] == 3:
        return jnp.broadcast_to(jnp.eye(3, dtype=edges.dtype), edges.shape)
    first, second = edges[..., 0], edges[..., 1]
    first = first / jnp.linalg.norm(first, axis=-1, keepdims=True)
    second = second - jnp.sum(first * second, axis=-1, keepdims=True) * first
    return jnp.stack([first, second / jnp.linalg.norm(second, axis=-1, keepdims=True)], axis=-1)


def _place(shape: tuple[int, ...], triangulation: Triangulation, at: str | None) -> str:
    """Return whether tensors of this shape belong to the vertices or to the cells (the faces of a surface)."""
    words = WORDS[triangulation.dimension]
    counts = {words.argument: len(triangulation.cells), "vertices": triangulation.n_vertices}
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


def _check(
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
    # In orthonormal frames, the eigenvalues do not depend on the shape of the triangle.
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
            "symmetric positive definite. Raise their eigenvalues, or check that their axes are those of the vertices"
        )
