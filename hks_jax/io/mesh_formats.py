"""Read meshes through meshio, polygonal data through VTK, and variants of OBJ and OFF that meshio does not support.

In a damaged file, meshio may omit points or cells without an error, so this module checks their numbers. The readers of
OBJ and OFF are the package's own: trimesh reads OFF files that are cut or declare other numbers of vertices and faces,
and cuts concave quadrilaterals into triangles outside of them; meshio reads only triangles in OFF, and keeps corners of
OBJ that count backwards or do not exist.
"""

import math
import re
import tempfile
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from hks_jax.io import gmsh
from hks_jax.io.vtk_image import load as through_vtk
from hks_jax.optional import optional
from hks_jax.storage import UnsuitedError


class Loaded(NamedTuple):
    """The content of a file: vertices, triangles or tetrahedra, and the arrays at both."""

    vertices: Float[np.ndarray, "V 3"]
    cells: Int[np.ndarray, "n corners"]
    arrays: Mapping[str, Float[np.ndarray, "V *components"]] = MappingProxyType({})
    of_cells: Mapping[str, Float[np.ndarray, "n *components"]] = MappingProxyType({})
    structure: str = ""  # of a brain's surface, in the terms of GIFTI, such as CortexLeft; empty if it is not known


def through_meshio(path: Path) -> Loaded:
    """Load triangles or tetrahedra through meshio."""
    suffix, content = path.suffix.lower(), path.read_bytes()
    library = optional("meshio")
    if suffix == ".vtu" and (found := re.search(rb"<VTKFile[^>]*\bcompressor\s*=\s*[\"'](vtkLZ4\w*)", content)):
        raise UnsuitedError(
            f"the data are compressed by {found[1].decode()}, which meshio does not read. Write the file with "
            "zlib compression (vtkZLibDataCompressor) or without compression"
        )
    declared = _declared(content, suffix)
    pieces = _pieces(content) if suffix == ".vtu" else []
    # meshio computes the length of a binary STL file from its number of triangles, which overflows for STL text.
    with np.errstate(over="ignore"):
        if suffix == ".msh":
            read = _gmsh(library, content)
        else:
            read = _joined(library, content, pieces) if len(pieces) > 1 else _read(library, content, suffix)
    _compare(content, suffix, declared, read)
    points = np.asarray(read.points, np.float64)
    blocks = [block.data for block in read.cells if block.type == "tetra"]
    if any(cells.shape[1:] != (4,) for cells in blocks):
        raise ValueError(f"got tetrahedra of shape {blocks[0].shape}; expected (n, 4)")
    if points.ndim != 2 or points.shape[1] not in (2, 3):
        raise ValueError(f"got points of shape {points.shape}; expected (V, 2) or (V, 3)")
    points = np.pad(points, ((0, 0), (0, 3 - points.shape[1])))
    arrays = real_arrays(read.point_data, len(points))
    which = [i for i, block in enumerate(read.cells) if block.type == "tetra"]
    which = which or [i for i, block in enumerate(read.cells) if block.type in ("triangle", "quad")]
    of_blocks = {name: [np.asarray(parts[i]) for i in which] for name, parts in read.cell_data.items()}
    others = {block.type for block in read.cells} - {"tetra", "triangle", "quad", "line", "vertex"}
    if others:
        raise UnsuitedError(f"got {', '.join(sorted(others))} cells; expected triangles, quadrilaterals or tetrahedra")
    if not which:
        raise UnsuitedError("the mesh has no triangles and no tetrahedra; expected one of these kinds of cell")
    parts = blocks or [fans(points, read.cells[i].data) for i in which]
    times = [1 if blocks else each.shape[1] for each in parts]  # a quadrilateral becomes two triangles
    cells = np.concatenate([each.reshape(-1, 4 if blocks else 3) for each in parts]).astype(np.int64)
    of_cells = {
        name: np.concatenate([np.repeat(values, n, axis=0) for values, n in zip(of_parts, times, strict=True)])
        for name, of_parts in of_blocks.items()
    }
    if suffix == ".msh":  # other arrays have values only at other elements
        of_cells = {name: values for name, values in of_cells.items() if not np.isnan(values).all()}
    return Loaded(points, cells, arrays, real_arrays(of_cells, len(cells)))


def _read(library: Any, content: bytes, suffix: str) -> Any:
    """Read the content of a file by meshio, in a form that meshio supports."""
    if suffix == ".vtk":
        content = _with_fields(content)
    elif suffix == ".vtu":  # for triangles and tetrahedra, the versions do not differ
        content = re.sub(rb"(<VTKFile[^>]*\bversion\s*=\s*[\"'])2\.\d+", rb"\g<1>1.0", content, count=1)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / f"mesh{suffix}"
        file.write_bytes(content)
        # The reader of the format is called, because meshio.read ends the process if it cannot read a file.
        return getattr(library, "gmsh" if suffix == ".msh" else suffix[1:]).read(str(file))


def _gmsh(library: Any, content: bytes) -> Any:
    """Read a Gmsh file by meshio, and its arrays by their tags."""
    bare, sections = gmsh.split(content)
    read = _read(library, bare, ".msh")
    sizes = [len(block.data) for block in read.cells]
    corners = np.repeat([block.data.shape[1] for block in read.cells], sizes)
    at_nodes, at_elements = gmsh.arrays(content, sections, corners)
    of_cells = {name: np.split(values, np.cumsum(sizes)[:-1]) for name, values in at_elements.items()}
    return library.Mesh(read.points, read.cells, at_nodes, of_cells)


_ATTRIBUTE = re.compile(rb"^(TENSORS6|NORMALS)[ \t]+(\S+)[ \t]+(\w+)[ \t]*\r?\n", re.MULTILINE | re.IGNORECASE)
_DATA = re.compile(rb"^(?:POINT|CELL)_DATA[ \t]+(\d+)", re.MULTILINE | re.IGNORECASE)


def _with_fields(content: bytes) -> bytes:
    """Return a legacy VTK file with tensors of six components and normals as field data, because meshio reads these."""

    def as_field(found: re.Match[bytes]) -> bytes:
        count = _DATA.findall(content, 0, found.start())[-1]
        components = b"6" if found[1].upper() == b"TENSORS6" else b"3"
        return b"FIELD attributes 1\n" + b" ".join([found[2], components, count, found[3]]) + b"\n"

    return _ATTRIBUTE.sub(as_field, content)


def _pieces(content: bytes) -> list[re.Match[bytes]]:
    """Return the pieces of a VTU file."""
    return list(re.finditer(rb"<Piece\b.*?</Piece>", content.partition(b"<AppendedData")[0], re.DOTALL))


def _joined(library: Any, content: bytes, pieces: list[re.Match[bytes]]) -> Any:
    """Read a VTU file of several pieces.

    meshio 5.3 returns the points of all pieces, but only the cells of the last piece. Therefore, the file is read once
    for each piece, which is moved behind the others.
    """
    sizes = [int(re.findall(_COUNTS[".vtu"][0], piece[0])[0]) for piece in pieces]
    begins, blocks, of_blocks = np.cumsum([0, *sizes]), [], []
    for i, piece in enumerate(pieces):
        others = b"".join(other[0] for other in pieces if other is not piece)
        whole = _read(library, content[: pieces[0].start()] + others + piece[0] + content[pieces[-1].end() :], ".vtu")
        for j, block in enumerate(whole.cells):
            blocks.append((block.type, block.data - (begins[-1] - sizes[i]) + begins[i]))
            of_blocks.append({name: parts[j] for name, parts in whole.cell_data.items()})
    names = [name for name in whole.cell_data if all(name in each for each in of_blocks)]
    of_cells = {name: [each[name] for each in of_blocks] for name in names}
    return library.Mesh(whole.points, blocks, whole.point_data, of_cells)


_COUNTS = {
    ".vtk": (rb"\bPOINTS\s+(-?\d+)\s+[a-zA-Z]", rb"\bCELL_TYPES\s+(-?\d+)[ \t]*[\r\n]"),
    ".vtu": (rb"NumberOfPoints\s*=\s*[\"'](-?\d+)", rb"NumberOfCells\s*=\s*[\"'](-?\d+)"),
}
"""Patterns of the declared numbers of points and cells in each format. For .stl, meshio checks the file's length."""


_GRID = re.compile(rb"DATASET\s+(?:STRUCTURED|RECTILINEAR)_GRID\s+DIMENSIONS\s+(\d+\s+\d+\s+\d+)", re.IGNORECASE)
"""The pattern of the numbers of points along the axes of legacy grids, whose cells are not listed."""


def _declared(content: bytes, suffix: str) -> tuple[int, ...]:
    """Return the declared numbers of points and cells, and for Gmsh also the largest tag of a point."""
    patterns = _COUNTS.get(suffix, ())
    declared = tuple(sum(map(int, re.findall(pattern, content))) for pattern in patterns)
    grid = _GRID.search(content) if suffix == ".vtk" else None
    if grid is not None:
        sizes = [int(size) for size in grid[1].split()]
        declared = (math.prod(sizes), math.prod(size - 1 for size in sizes if size > 1))
    if suffix == ".msh":
        declared = gmsh.declared(content)
    if max(declared, default=0) > 8 * len(content):
        raise ValueError(f"the file declares {max(declared)} points or cells, but has only {len(content)} bytes")
    return declared


def _compare(content: bytes, suffix: str, declared: tuple[int, ...], mesh: Any) -> None:
    """Raise ValueError unless the points, the cells and, in .vtk, the number of corners are as declared."""
    counts = (len(mesh.points), sum(len(block.data) for block in mesh.cells))
    if declared and declared[:2] != counts:
        what = "the file declares {} points and {} cells, but has {} and {}"
        raise ValueError(what.format(*declared[:2], *counts))
    corners = sum(block.data.size for block in mesh.cells)
    lists = re.search(rb"\bCELLS\s+(\d+)\s+(\d+)", content) if suffix == ".vtk" else None
    if lists is not None:  # before VTK's file version 5, the length of CELLS also counts one entry per cell
        listed = int(lists[2]) - (0 if re.match(rb"# vtk DataFile Version [5-9]", content) else counts[1])
        if listed != corners:  # if a cell's type is wrong, meshio omits corners
            raise ValueError(f"the file lists {listed} corners, but cells of the declared types have {corners}")


def polygonal(path: Path) -> Loaded:
    """Load polygonal data through VTK, with polygons cut into triangles."""
    data = through_vtk(path)
    if "faces" not in data:
        raise ValueError(f"got {data['kind']}; expected vtkPolyData")
    points, faces = data["points"].astype(np.float64), data["faces"].astype(np.int64)
    at_points, at_cells = (
        {key.removeprefix(place): values for key, values in data.items() if key.startswith(place)}
        for place in ("point:", "cell:")
    )
    of_faces = {name: values[data["cells_of_faces"]] for name, values in at_cells.items()}
    return Loaded(points, faces, real_arrays(at_points, len(points)), real_arrays(of_faces, len(faces)))


def real_arrays(named: Mapping[str, Any], n: int) -> dict[str, Float[np.ndarray, "n *components"]]:
    """Return the real arrays with n rows, one per vertex or cell, without Gmsh's tags."""
    arrays = {key: np.asarray(values) for key, values in named.items() if not key.startswith("gmsh:")}
    return {
        key: values.astype(np.result_type(values.dtype, np.float32))
        for key, values in arrays.items()
        if values.ndim and len(values) == n and values.dtype.kind in "fiub"
    }


def fans(
    points: Float[np.ndarray, "V 3"],
    polygons: Int[np.ndarray, "n corners"],
    numbers: Int[np.ndarray, " n"] | None = None,
) -> Int[np.ndarray, "n m 3"]:
    """Cut each polygon into triangles that share its first corner from which all other corners are visible.

    Raises:
        UnsuitedError: a polygon has a vertex that does not exist, or no corner that sees all other corners.
    """
    if polygons.ndim != 2 or polygons.shape[1] < 3:
        raise UnsuitedError(f"got faces of shape {polygons.shape}; expected at least 3 corners each")
    (n, size), low, high = polygons.shape, polygons.min(initial=0), polygons.max(initial=0)
    if low < 0 or high >= len(points):
        raise UnsuitedError(f"a face refers to vertex {low if low < 0 else high}; expected 0 … {len(points) - 1}")
    if size == 3:
        return polygons[:, None]
    found = np.full((n, size - 2, 3), -1)
    for first in reversed(range(size)):
        turned = np.roll(polygons, -first, axis=1)
        fan = np.stack([np.broadcast_to(turned[:, :1], (n, size - 2)), turned[:, 1:-1], turned[:, 2:]], axis=-1)
        a, b, c = np.moveaxis(points[fan], 2, 0)
        with np.errstate(over="ignore", invalid="ignore"):  # vertices may be far away or not finite
            normals = np.cross(b - a, c - a)
            along = np.einsum("nmx,nx->nm", normals, normals.sum(axis=1))
        seen = ~(along < 0).any(axis=1)
        found[seen] = fan[seen]
    bad = np.flatnonzero((found < 0).any(axis=(1, 2)))
    if bad.size:
        which = bad[0] if numbers is None else numbers[bad[0]]
        raise UnsuitedError(
            f"face {which} with {size} corners is not star-shaped about any corner. Cut it into triangles"
        )
    return found


_KEYWORD = re.compile(r"(ST)?C?N?OFF")
"""The first word of OFF files. ST, C and N mean that vertices have texture coordinates, colours and normals."""


def load_obj(file: Path) -> Loaded:
    """Load the vertices and faces of an OBJ file; ignore normals, texture coordinates, colours and groups."""
    vertices: list[list[float]] = []
    polygons: list[list[int]] = []
    text = file.read_text(encoding="utf-8", errors="replace").replace("\\\n", " ")
    for number, line in enumerate(text.splitlines(), 1):
        words = line.partition("#")[0].split()
        if words[:1] == ["v"]:
            if len(words) < 4:
                raise ValueError(f"line {number}: got {len(words) - 1} coordinates for a vertex; expected 3")
            vertices.append([float(word) for word in words[1:4]])
        elif words[:1] == ["f"]:
            corners = [int(word.partition("/")[0]) for word in words[1:]]
            if 0 in corners or len(corners) < 3:
                raise ValueError(f"line {number}: got the face {' '.join(words[1:])}; expected 3 vertices or more")
            # Vertices are numbered from 1. A negative number counts backwards from the last vertex read so far.
            polygons.append([corner - 1 if corner > 0 else len(vertices) + corner for corner in corners])
    return _by_size(vertices, polygons)


def load_off(file: Path) -> Loaded:
    """Load the vertices and faces of an OFF file; ignore colours, normals and texture coordinates."""
    text = file.read_text(encoding="utf-8", errors="replace")
    lines = [line for line in (line.partition("#")[0].strip() for line in text.splitlines()) if line]
    keyword = _KEYWORD.match(lines[0]) if lines else None
    if keyword is None:
        raise ValueError("the file does not begin with OFF, COFF, NOFF or STOFF")
    # The numbers of vertices and faces follow the keyword on the same line, even without a space, or on the next.
    head, *rest = filter(None, (lines[0][keyword.end() :].strip(), *lines[1:]))
    n_vertices, n_faces = (int(word) for word in head.split()[:2])
    if min(n_vertices, n_faces) < 0 or len(rest) != n_vertices + n_faces:
        raise ValueError(
            f"the file declares {n_vertices} vertices and {n_faces} faces, but has {len(rest)} lines for them"
        )
    rows = [line.split() for line in rest]
    columns = {len(row) for row in rows[:n_vertices]}
    if len(columns) != 1 or min(columns) < 3:
        raise ValueError(f"lines of vertices have {sorted(columns)} columns; expected equal numbers, at least 3")
    vertices = [[float(word) for word in row[:3]] for row in rows[:n_vertices]]
    polygons = [[int(word) for word in row[1 : 1 + int(row[0])]] for row in rows[n_vertices:]]
    for row, corners in zip(rows[n_vertices:], polygons, strict=True):
        # In the line of a face, a colour may follow the corners: an index, or three or four numbers.
        if len(corners) != int(row[0]) or len(corners) < 3 or len(row) - 1 - len(corners) > 4:
            raise ValueError(f"got the face {' '.join(row)[:60]}; expected n, n corners, an optional colour")
    return _by_size(vertices, polygons)


def triangulated(
    points: Float[np.ndarray, "V 3"], polygons: list[tuple[Int[np.ndarray, " _"], Int[np.ndarray, "_ _"]]]
) -> tuple[Loaded, Int[np.ndarray, " triangles"]]:
    """Cut polygons into triangles, and return the triangles in the order of the polygons, with their polygons' numbers.

    Each entry of `polygons` has the numbers of polygons with n corners, and their corners.
    """
    if not polygons:
        raise UnsuitedError("the mesh has no triangles; expected at least one face")
    triangles = [fans(points, corners, which) for which, corners in polygons]
    polygon = np.concatenate(
        [np.repeat(which, each.shape[1]) for (which, _), each in zip(polygons, triangles, strict=True)]
    )
    order = np.argsort(polygon, kind="stable")
    return Loaded(points, np.concatenate([each.reshape(-1, 3) for each in triangles])[order]), polygon[order]


def _by_size(vertices: list[list[float]], polygons: list[list[int]]) -> Loaded:
    """Return the triangles of polygons."""
    sizes = np.array([len(polygon) for polygon in polygons], np.int64)
    groups = [
        (which, np.array([polygons[i] for i in which]))
        for which in map(np.flatnonzero, sizes == np.unique(sizes)[:, None])
    ]
    return triangulated(np.array(vertices, np.float64).reshape(-1, 3), groups)[0]
