"""Meshes in Wavefront's OBJ and in OFF, which are texts, in the dialects that programs write."""

import re
from pathlib import Path

import numpy as np

from hks_jax.io.mesh_formats import Loaded, fans
from hks_jax.reading import reading

_KEYWORD = re.compile(r"(ST)?C?N?OFF")
"""What OFF files begin with; the letters say that vertices also have coordinates of a texture, colours and normals."""


def load_obj(file: Path) -> Loaded:
    """Load the vertices and faces of an OBJ file; normals, texture coordinates, colours and groups are passed over."""
    vertices: list[list[float]] = []
    polygons: list[list[int]] = []
    with reading(file, "a readable OBJ mesh"):
        text = file.read_text(encoding="utf-8", errors="replace").replace("\\\n", " ")
        for number, line in enumerate(text.splitlines(), 1):
            words = line.partition("#")[0].split()
            if words[:1] == ["v"]:
                if len(words) < 4:
                    raise ValueError(f"line {number}: a vertex of {len(words) - 1} coordinates")
                vertices.append([float(word) for word in words[1:4]])
            elif words[:1] == ["f"]:
                corners = [int(word.partition("/")[0]) for word in words[1:]]
                if 0 in corners or len(corners) < 3:
                    raise ValueError(f"line {number}: a face {' '.join(words[1:])}")
                # They count from 1; negative ones count back from the vertices so far.
                polygons.append([corner - 1 if corner > 0 else len(vertices) + corner for corner in corners])
    return _triangulated(file, vertices, polygons)


def load_off(file: Path) -> Loaded:
    """Load the vertices and faces of an OFF file; colours, normals and texture coordinates are passed over."""
    with reading(file, "a readable OFF mesh"):
        text = file.read_text(encoding="utf-8", errors="replace")
        lines = [line for line in (line.partition("#")[0].strip() for line in text.splitlines()) if line]
        keyword = _KEYWORD.match(lines[0]) if lines else None
        if keyword is None:
            raise ValueError("it does not begin with OFF, COFF, NOFF or STOFF")
        # The numbers follow on the same line, also without a space, or on the next.
        head, *rest = filter(None, (lines[0][keyword.end() :].strip(), *lines[1:]))
        n_vertices, n_faces = (int(word) for word in head.split()[:2])
        if min(n_vertices, n_faces) < 0 or len(rest) != n_vertices + n_faces:
            raise ValueError(
                f"it declares {n_vertices} vertices and {n_faces} faces, and has {len(rest)} lines for them"
            )
        rows = [line.split() for line in rest]
        if len({len(row) for row in rows[:n_vertices]}) != 1:
            raise ValueError("its vertices do not have the same number of columns, one vertex a line")
        vertices = [[float(word) for word in row[:3]] for row in rows[:n_vertices]]
        polygons = [[int(word) for word in row[1 : 1 + int(row[0])]] for row in rows[n_vertices:]]
        for row, corners in zip(rows[n_vertices:], polygons, strict=True):
            # Behind the corners: a colour, by its index or three or four numbers.
            if len(corners) != int(row[0]) or len(corners) < 3 or len(row) - 1 - len(corners) > 4:
                raise ValueError(f"a face {' '.join(row)[:60]}")
    return _triangulated(file, vertices, polygons)


def _triangulated(file: Path, vertices: list[list[float]], polygons: list[list[int]]) -> Loaded:
    """Return the mesh with its polygons cut into triangles, in the order of the file."""
    if not polygons:
        raise ValueError(f"{file}: has no triangles; expected a mesh")
    with reading(file, "a readable mesh"):
        points = np.array(vertices, np.float64).reshape(-1, 3)
        low, high = min(map(min, polygons)), max(map(max, polygons))
        if low < 0 or high >= len(points):
            raise ValueError(f"a face has the vertex {low if low < 0 else high} of 0 … {len(points) - 1}")
    order, triangles = [], []
    for size in {len(polygon) for polygon in polygons}:
        which = np.flatnonzero([len(polygon) == size for polygon in polygons])
        cut = fans(points, np.array([polygons[i] for i in which]))
        if (cut < 0).any():
            bad = which[np.argmax((cut < 0).any(axis=(1, 2)))]
            raise ValueError(
                f"{file}: face {bad} of {size} corners is not convex; have it cut into triangles by what wrote it"
            )
        order.append(np.repeat(which, size - 2))
        triangles.append(cut.reshape(-1, 3))
    return Loaded(points, np.concatenate(triangles)[np.argsort(np.concatenate(order), kind="stable")], {})
