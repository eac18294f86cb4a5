"""Checks of the arrays that describe triangles or tetrahedra in space."""

from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
import scipy
from jaxtyping import Bool, Float, Int

from hks_jax.accuracy import warn_of_accuracy
from hks_jax.checks import require_static
from hks_jax.domain import spd
from hks_jax.domain.components import as_mask
from hks_jax.domain.tensor_checks import lost_determinants, scaled_to_one
from hks_jax.domain.triangulation import Triangulation

_FLAT = 1e-10
"""A simplex is degenerate if d! times its volume is at most this number times the d-th power of its longest edge."""
_THIN = 10
"""A simplex is thin if rounding may spoil its metric: if the metric's determinant, relative to the longest edge, is
below this number times ε."""
_ON_EDGE = 1e-6
"""A vertex is on an edge if its distance from the edge is at most this fraction of the edge's length."""


class Words(NamedTuple):
    """The words that messages use for triangles or for tetrahedra."""

    argument: str
    letter: str
    one: str
    simplex: str
    simplices: str
    measure: str


WORDS = {
    2: Words("faces", "F", "face", "triangle", "triangles", "area"),
    3: Words("cells", "C", "cell", "tetrahedron", "tetrahedra", "volume"),
}


def checked_cells(cells: Any, n_vertices: int, dimension: int, masked: bool) -> Int[np.ndarray, "n corners"]:
    """Return the vertex indices of simplices; raise ValueError unless they are integers (n, d + 1) in range.

    Without a mask every vertex must belong to a simplex.
    """
    words = WORDS[dimension]
    require_static(words.argument, cells)
    indices = np.asarray(cells)
    if indices.ndim != 2 or indices.shape[1] != dimension + 1 or not np.issubdtype(indices.dtype, np.integer):
        raise ValueError(
            f"{words.argument}: got shape {indices.shape}, dtype {indices.dtype}; expected integers of shape "
            f"({words.letter}, {dimension + 1})"
        )
    if indices.size == 0 or indices.min() < 0 or indices.max() >= n_vertices:
        span = f"{indices.min()} … {indices.max()}" if indices.size else f"no {words.argument}"
        raise ValueError(
            f"{words.argument}: got vertex indices {span}; expected 0 … {n_vertices - 1} for {n_vertices} vertices"
        )
    used = np.isin(np.arange(n_vertices), indices)
    if not (used.all() or masked):
        raise ValueError(
            f"vertices: {int((~used).sum())} of {n_vertices} belong to no {words.one} (the first is vertex "
            f"{int(np.argmin(used))}); remove them, or exclude them by a mask"
        )
    return indices


def checked_mask(
    mask: Any, cells: Int[np.ndarray, "n corners"], n_vertices: int, dimension: int
) -> Bool[np.ndarray, " n"]:
    """Return the simplices inside a mask of simplices, or the simplices with all vertices inside a mask of vertices.

    Raises:
        ValueError: another shape; values other than 0 and 1; an ambiguous mask; a mask without a simplex.
    """
    require_static("mask", mask)
    words, inside = WORDS[dimension], np.asarray(mask)
    if inside.shape not in ((n_vertices,), (len(cells),)):
        raise ValueError(
            f"mask: got shape {inside.shape}; expected {(n_vertices,)}, one for each vertex, or {(len(cells),)}, one "
            f"for each {words.one}"
        )
    inside = as_mask("mask", inside)
    kept = inside[cells].all(axis=1) if len(inside) == n_vertices else inside
    if len(inside) == len(cells) and (kept != inside).any():
        raise ValueError(
            f"mask: got {n_vertices} values for {n_vertices} vertices and as many {words.argument}, which is "
            f"ambiguous; to mask {words.argument}, pass {words.argument}[mask] and a mask that is True everywhere"
        )
    if not kept.any():
        places = "vertices" if len(inside) == n_vertices else words.argument
        raise ValueError(f"mask: {int(inside.sum())} of {inside.size} {places} are inside, but no {words.simplex} is")
    return kept


def signed_measure(
    vertices: Float[np.ndarray, "V 3"], cells: Int[np.ndarray, "n corners"]
) -> tuple[Float[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Return d! times the area or signed volume of each simplex, and whether it is nonzero beyond rounding."""
    corners = vertices[cells]
    edges = corners[:, 1:] - corners[:, :1]
    with np.errstate(over="ignore", invalid="ignore"):  # products of large coordinates may overflow
        normal = np.cross(edges[:, 0], edges[:, 1])
        measure = np.linalg.norm(normal, axis=1) if len(edges[0]) == 2 else np.sum(normal * edges[:, 2], axis=1)
        pairs = combinations(range(cells.shape[1]), 2)
        longest = np.max([np.sum((corners[:, a] - corners[:, b]) ** 2, axis=1) for a, b in pairs], axis=0)
        return measure, np.abs(measure) > _FLAT * longest ** (len(edges[0]) / 2)


def check_places(vertices: Float[np.ndarray, "V 3"], triangulation: Triangulation, whole: bool = True) -> None:
    """Raise ValueError for vertices that are not finite, and for degenerate, inverted or overlapping simplices.

    Two triangles overlap if they have the same vertices. Warn if three triangles of a surface share an edge, if an edge
    of a surface passes through a vertex, or if parts of a ``whole`` mesh touch only at vertices, as the ragged rim of a
    mask may.
    """
    infinite = triangulation.used & ~np.isfinite(vertices).all(axis=1)
    if infinite.any():
        raise ValueError(
            f"vertices: {int(infinite.sum())} are NaN or infinite (the first is vertex {int(np.argmax(infinite))}); "
            "remove them"
        )
    words, cells = WORDS[triangulation.dimension], triangulation.cells
    measure, sound = signed_measure(vertices, cells)
    if not sound.all():
        raise ValueError(
            f"{words.argument}: {int((~sound).sum())} of {len(cells)} {words.simplices} have no {words.measure} "
            f"(the first is {words.one} {int(np.argmin(sound))}); remove or merge them"
        )
    if triangulation.dimension == 2:
        _check_once(cells)
        crowded = triangulation.crowded_facets
        if crowded.size:
            edge = triangulation.facet_vertices(crowded[:1])[0].tolist()
            warn_of_accuracy(
                f"faces: {crowded.size} edges belong to three triangles or more (the first has the vertices {edge}): "
                "heat flows into all branches of the surface there. To avoid this, keep at most two triangles per edge"
            )
        if not _warn_of_hanging(vertices, triangulation) and whole:  # parts also touch at the ends of a crack
            _warn_of_pinched(triangulation)
        return
    inverted = measure < 0
    if inverted.any():
        raise ValueError(
            f"cells: {int(inverted.sum())} of {len(cells)} tetrahedra are inverted (the first is cell "
            f"{int(np.argmax(inverted))}): seen from v₃, the order v₀ v₁ v₂ should be counterclockwise, so that "
            "(v₁ − v₀) × (v₂ − v₀) · (v₃ − v₀) > 0. If the mesh is folded, move its vertices apart; if the order is "
            "wrong, swap two vertices: cells[inverted] = cells[inverted][:, [1, 0, 2, 3]]"
        )
    overlaps = triangulation.overlaps
    if len(overlaps):
        a, b = overlaps[0]
        raise ValueError(
            f"cells: {len(overlaps)} pairs of tetrahedra overlap, as they lie on one side of a common triangle (the "
            f"first pair is cells {a} and {b}); remove duplicates, or move the vertices of a folded mesh apart"
        )
    if whole:
        _warn_of_pinched(triangulation)


def _warn_of_pinched(triangulation: Triangulation) -> None:
    """Warn if parts of a mesh touch only at vertices (of a solid, also along edges)."""
    found = triangulation.pinched_vertices
    if found.size:
        words, first = WORDS[triangulation.dimension], int(found[0])
        shared = {2: "an edge", 3: "a triangle"}[triangulation.dimension]
        cells = np.flatnonzero((triangulation.cells == first).any(axis=1))
        listed = ", ".join(map(str, cells[:8])) + " …" * (cells.size > 8)
        warn_of_accuracy(
            f"{words.argument}: at {found.size} vertices, parts of the mesh touch without sharing {shared} there (the "
            f"first is vertex {first}, with the {words.argument} {listed}). Heat cannot pass through a point, but "
            "it passes through a shared vertex, more on a coarser mesh, so results depend on the mesh. Give each part "
            f"a vertex of its own there, or join the parts by {words.simplices} that share {shared}"
        )


def check_metric(
    metric: Float[np.ndarray, "n d d"], vertices: Float[np.ndarray, "V 3"], cells: Int[np.ndarray, "n corners"]
) -> None:
    """Raise ValueError if rounding, underflow or overflow spoils the induced metric of a simplex at these vertices."""
    words, dtype = WORDS[cells.shape[1] - 1], metric.dtype
    positions = vertices.astype(np.float64)
    edges = positions[cells[:, 1:]] - positions[cells[:, :1]]
    longest = np.abs(edges).max(axis=(1, 2), keepdims=True)
    shape = edges / longest
    thin = spd.determinant(shape @ np.swapaxes(shape, 1, 2)) < _THIN * np.finfo(dtype).eps
    with np.errstate(over="ignore", invalid="ignore"):
        lost, digits = lost_determinants(*scaled_to_one(edges @ np.swapaxes(edges, 1, 2)), dtype)
    of_unit, wrong = lost & ~thin, np.isnan(metric).any(axis=(1, 2))
    remedy = ", or use float64" * (dtype != np.float64)
    if of_unit.any():
        first = int(np.argmax(of_unit))
        raise ValueError(
            f"vertices: {int(of_unit.sum())} of {len(cells)} {words.simplices} are so small or large that the "
            f"determinant of their metric, about 1e{digits[first]:.0f}, is beyond the accurate range of {dtype} (the "
            f"first is {words.one} {first}, with edges of about {longest[first, 0, 0]:.1g}). Use a unit of length in "
            f"which edges are near 1{remedy}"
        )
    if wrong.any():
        first = int(np.argmax(wrong))
        raise ValueError(
            f"{words.argument}: {int(wrong.sum())} of {len(cells)} {words.simplices} are so thin that their metric is "
            f"lost to rounding in {dtype} (the first is {words.one} {first}, vertices {cells[first].tolist()}); merge "
            f"or move their vertices{remedy}"
        )


def _check_once(faces: Int[np.ndarray, "F 3"]) -> None:
    vertices = np.sort(faces, axis=1)
    order = np.lexsort(vertices.T[::-1])
    again = np.flatnonzero((vertices[order[1:]] == vertices[order[:-1]]).all(axis=1))
    if again.size:
        a, b = sorted(order[again[0] : again[0] + 2].tolist())
        raise ValueError(
            f"faces: {again.size} of {len(faces)} triangles occur twice (the first are faces {a} and {b}, with the "
            f"vertices {faces[a].tolist()}), and would count twice; remove the duplicates"
        )


def _warn_of_hanging(vertices: Float[np.ndarray, "V 3"], triangulation: Triangulation) -> bool:
    """Warn if a vertex lies between the ends of a boundary edge, so that the triangles on both sides do not connect.

    Returns whether there is such a vertex.
    """
    edges = triangulation.facet_vertices(triangulation.boundary_facets)
    rim = np.unique(edges)
    if not rim.size:
        return False
    start, end = vertices[edges[:, 0]], vertices[edges[:, 1]]
    length = np.linalg.norm(end - start, axis=1)
    near = scipy.spatial.cKDTree(vertices[rim]).query_ball_point((start + end) / 2, length * (0.5 + _ON_EDGE))
    which = np.repeat(np.arange(len(edges)), [len(found) for found in near])
    vertex = rim[np.concatenate(near).astype(int)]
    along = (end - start)[which] / length[which, None]
    offset = vertices[vertex] - start[which]
    part = np.sum(offset * along, axis=1)
    apart = np.linalg.norm(offset - part[:, None] * along, axis=1)
    inner = np.abs(part / length[which] - 0.5) < 0.5 - _ON_EDGE
    hanging = np.flatnonzero(inner & (apart <= _ON_EDGE * length[which]))
    if hanging.size:
        first = hanging[0]
        warn_of_accuracy(
            f"faces: {np.unique(vertex[hanging]).size} vertices lie on edges that they do not belong to (the first is "
            f"vertex {vertex[first]}, on the edge of the vertices {edges[which[first]].tolist()}): the surface is torn "
            "at these edges, and no heat flows across them. Split the triangle of each edge at the vertex on it"
        )
    return bool(hanging.size)
