"""Triangles and tetrahedra in space as arrays: their checks, and which of them are degenerate."""

from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from hks_jax.domain.triangulation import Triangulation

_FLAT = 1e-10
"""The area (volume) of a simplex, relative to that of the cube over its longest edge, up to which it has none."""


class Words(NamedTuple):
    """What simplices of a dimension are called in messages."""

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


def checked_cells(cells: Any, n_vertices: int, dimension: int) -> Int[np.ndarray, "n corners"]:
    """Return the vertex indices of simplices; raise ValueError unless they have that shape and every vertex is used."""
    words, indices = WORDS[dimension], np.asarray(cells)
    if indices.ndim != 2 or indices.shape[1] != dimension + 1 or not np.issubdtype(indices.dtype, np.integer):
        raise ValueError(
            f"{words.argument}: got shape {indices.shape}, dtype {indices.dtype}; expected integers of shape "
            f"({words.letter}, {dimension + 1})"
        )
    if indices.size == 0 or indices.min() < 0 or indices.max() >= n_vertices:
        span = f"{indices.min()} … {indices.max()}" if indices.size else f"no {words.argument}"
        raise ValueError(
            f"{words.argument}: got vertex indices {span}; expected 0 … {n_vertices - 1}, as there are {n_vertices} "
            "vertices"
        )
    used = np.zeros(n_vertices, dtype=bool)
    used[indices] = True
    if not used.all():
        raise ValueError(
            f"vertices: {int((~used).sum())} of {n_vertices} belong to no {words.one} (the first is vertex "
            f"{int(np.argmin(used))}); remove them"
        )
    return indices


def signed_measure(
    vertices: Float[np.ndarray, "V 3"], cells: Int[np.ndarray, "n corners"]
) -> tuple[Float[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Return d! times the area or signed volume of each simplex, and whether it has one beyond rounding."""
    corners = vertices[cells]
    edges = corners[:, 1:] - corners[:, :1]
    with np.errstate(over="ignore", invalid="ignore"):  # of vertices so far away that no area is a number
        normal = np.cross(edges[:, 0], edges[:, 1])
        measure = np.linalg.norm(normal, axis=1) if len(edges[0]) == 2 else np.sum(normal * edges[:, 2], axis=1)
        pairs = combinations(range(cells.shape[1]), 2)
        longest = np.max([np.sum((corners[:, a] - corners[:, b]) ** 2, axis=1) for a, b in pairs], axis=0)
        return measure, np.abs(measure) > _FLAT * longest ** (len(edges[0]) / 2)


def check_places(vertices: Float[np.ndarray, "V 3"], triangulation: Triangulation) -> None:
    """Raise ValueError for vertices that are not finite, and for degenerate, inverted or overlapping simplices."""
    infinite = ~np.isfinite(vertices).all(axis=1)
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
        return
    inverted = measure < 0
    if inverted.any():
        raise ValueError(
            f"cells: {int(inverted.sum())} of {len(cells)} tetrahedra are inverted (the first is cell "
            f"{int(np.argmax(inverted))}): seen from v₃, v₀ v₁ v₂ should go round counterclockwise, so that "
            "(v₁ − v₀) × (v₂ − v₀) · (v₃ − v₀) > 0. Move the vertices of a folded mesh apart; if only the order is the "
            "other one, swap two vertices: cells[inverted] = cells[inverted][:, [1, 0, 2, 3]]"
        )
    overlaps = triangulation.overlaps
    if len(overlaps):
        a, b = overlaps[0]
        raise ValueError(
            f"cells: {len(overlaps)} pairs of tetrahedra overlap, as they lie on one side of a common triangle (the "
            f"first are cells {a} and {b}); remove duplicates, and move the vertices of a folded mesh apart"
        )
