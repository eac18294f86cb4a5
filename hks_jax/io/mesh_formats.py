"""Read meshes through meshio, polygonal data through VTK, and variants of OBJ and OFF that meshio does not support.

In a damaged file, meshio may omit points or cells without an error, so this module checks their numbers.
"""

import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from hks_jax.io.vtk_image import load as through_vtk
from hks_jax.optional import optional
from hks_jax.storage import reading


class Loaded(NamedTuple):
    """The content of a file: vertices, triangles or tetrahedra, and arrays at the vertices."""

    vertices: Float[np.ndarray, "V 3"]
    cells: Int[np.ndarray, "n corners"]
    arrays: dict[str, Float[np.ndarray, "V *components"]]


def through_meshio(path: Path) -> Loaded:
    """Load triangles or tetrahedra through meshio; raise ValueError for other cells and damaged files."""
    suffix = path.suffix.lower()
    library = optional("meshio")
    # meshio computes the length of a binary STL file from its number of triangles, which overflows for STL text.
    with reading(path, f"a mesh that meshio can read as {suffix}"), np.errstate(over="ignore"):
        content = path.read_bytes()
        declared = _declared(content, suffix)
        # The reader of the format is called, because meshio.read ends the process if it cannot read a file.
        read = getattr(library, "gmsh" if suffix == ".msh" else suffix[1:]).read(str(path))
        _compare(content, suffix, declared, read)
        points = np.asarray(read.points, np.float64)
        blocks = [block.data for block in read.cells if block.type == "tetra"]
        if any(cells.shape[1:] != (4,) for cells in blocks):
            raise ValueError(f"got tetrahedra of shape {blocks[0].shape}; expected (n, 4)")
        if points.ndim != 2 or points.shape[1] not in (2, 3):
            raise ValueError(f"got points of shape {points.shape}; expected (V, 2) or (V, 3)")
        points = np.pad(points, ((0, 0), (0, 3 - points.shape[1])))
        arrays = _real_arrays(read.point_data, len(points))
    others = {block.type for block in read.cells} - {"tetra", "triangle", "quad", "line", "vertex"}
    if others:
        raise ValueError(
            f"{path}: got {', '.join(sorted(others))} cells; expected triangles, quadrilaterals or tetrahedra"
        )
    surfaces = [block.data for block in read.cells if block.type in ("triangle", "quad")]
    blocks = blocks or [fans(path, points, cells).reshape(-1, 3) for cells in surfaces]
    if not blocks:
        raise ValueError(f"{path}: the mesh has no triangles and no tetrahedra; expected one of these kinds of cell")
    return Loaded(points, np.concatenate(blocks).astype(np.int64), arrays)


_GMSH = re.compile(rb"\s*(?:\$Comments.*?\$EndComments\s*)?\$MeshFormat\s+(\S+)\s+([01])\s+([48])\b", re.DOTALL)
_COUNTS = {
    ".ply": (rb"element\s+vertex\s+(-?\d+)", rb"element\s+face\s+(-?\d+)"),
    ".vtk": (rb"\bPOINTS\s+(-?\d+)", rb"\bCELL_TYPES\s+(-?\d+)"),
    ".vtu": (rb"NumberOfPoints\s*=\s*[\"'](-?\d+)", rb"NumberOfCells\s*=\s*[\"'](-?\d+)"),
}
"""Patterns of the declared numbers of points and cells in each format. For .stl, meshio checks the file's length."""

_PLY = {"char": 1, "uchar": 1, "short": 2, "ushort": 2, "int": 4, "uint": 4, "float": 4, "double": 8}
"""The size in bytes of each PLY type that has a C name. PLY's other types, such as int32, have NumPy's names."""


def _declared(content: bytes, suffix: str) -> tuple[int, ...]:
    """Return the declared numbers of points and cells, and for Gmsh also the largest tag of a point."""
    patterns = _COUNTS.get(suffix, ())
    declared = tuple(sum(map(int, re.findall(pattern, content))) for pattern in patterns)
    if suffix == ".msh":
        declared = _declared_by_gmsh(content)
    if max(declared, default=0) > 8 * len(content):
        raise ValueError(f"the file declares {max(declared)} points or cells, but has only {len(content)} bytes")
    return declared


def _compare(content: bytes, suffix: str, declared: tuple[int, ...], mesh: Any) -> None:
    """Raise ValueError unless the points, the cells and, in .vtk and .ply, the length of their data are as declared."""
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
    if suffix == ".ply":
        _compare_ply(content, mesh)


def _compare_ply(content: bytes, mesh: Any) -> None:
    head, _, body = re.split(rb"(\bend_header\s*?\n)", content, maxsplit=1)
    ascii_ = b"format ascii" in head
    of_points, _, of_cells = head.partition(b"element face")
    lists = re.findall(rb"property\s+list\s+(\w+)\s+(\w+)", of_cells)
    if len(lists) != 1:
        return  # the length of the faces' data is known only if each face has one list, of its corners

    def size(name: bytes) -> int:
        return 1 if ascii_ else _PLY.get(name.decode()) or np.dtype(name.decode()).itemsize

    length, index = map(size, lists[0])
    scalar = re.compile(rb"property\s+(?!list)(\w+)")
    point, cell = (sum(map(size, scalar.findall(part))) for part in (of_points, of_cells))
    of_blocks = (len(b.data) * (length + index * b.data.shape[1] + cell) for b in mesh.cells)
    wanted, got = len(mesh.points) * point + sum(of_blocks), len(body.split() if ascii_ else body)
    if wanted != got:
        raise ValueError(f"got {got} {'words' if ascii_ else 'bytes'} of points and cells; expected {wanted}")


def _declared_by_gmsh(content: bytes) -> tuple[int, int, int]:
    """Return the declared numbers of nodes and elements, and the largest node tag, the length of an array in meshio."""
    head = _GMSH.match(content)
    if head is None or head[1] not in (b"2", b"2.2", b"4", b"4.1"):
        version = "no Gmsh format" if head is None else f"Gmsh format {head[1].decode(errors='replace')}"
        raise ValueError(f"got {version}; expected 2.2 or 4.1. Convert the file by gmsh -format msh41")
    text, width = head[2] == b"0", int(head[3])
    nodes, elements = (_section(content, name) for name in (b"Nodes", b"Elements"))
    if head[1].startswith(b"4"):
        (_, n_nodes, _, largest), (_, n_elements, _, _) = (
            map(int, each.split(maxsplit=4)[:4] if text else np.frombuffer(each[: 4 * width], f"<u{width}"))
            for each in (nodes, elements)
        )
    else:
        n_nodes, n_elements = (int(each.partition(b"\n")[0]) for each in (nodes, elements))
        for each, declared in ((nodes, n_nodes), (elements, n_elements)) if text else ():
            there = sum(1 for line in each.splitlines()[1:] if line.strip())
            if there != declared:  # meshio ignores further lines
                raise ValueError(f"the file declares {declared} nodes or elements, but has {there} lines for them")
        rows, node = nodes.partition(b"\n")[2], np.dtype("<i4, (3,)<f8")
        tags = map(int, rows.split()[::4]) if text else np.frombuffer(rows[: n_nodes * node.itemsize], node)["f0"]
        largest = int(max(tags, default=0))
    return n_nodes, n_elements, largest


def _section(content: bytes, name: bytes) -> bytes:
    start, end = re.search(rb"\$" + name + rb"[ \t]*\r?\n", content), content.rfind(b"$End" + name)
    if start is None or end < start.end():
        raise ValueError(f"the file has no complete section ${name.decode()}")
    return content[start.end() : end]


def polygonal(path: Path) -> Loaded:
    """Load polygonal data through VTK, with polygons cut into triangles."""
    with reading(path, "readable polygonal data"):
        data = through_vtk(path)
        if "faces" not in data:
            raise ValueError(f"got {data['kind']}; expected vtkPolyData")
        points = data["points"].astype(np.float64)
    arrays = {key.removeprefix("point:"): values for key, values in data.items() if key.startswith("point:")}
    return Loaded(points, data["faces"].astype(np.int64), _real_arrays(arrays, len(points)))


def _real_arrays(named: dict[str, Any], n_points: int) -> dict[str, Float[np.ndarray, "V *components"]]:
    """Return the real arrays that have one row per point, without Gmsh's tags."""
    arrays = {key: np.asarray(values) for key, values in named.items() if not key.startswith("gmsh:")}
    return {
        key: values.astype(np.result_type(values.dtype, np.float32))
        for key, values in arrays.items()
        if values.ndim and len(values) == n_points and values.dtype.kind in "fiub"
    }


def fans(
    file: Path,
    points: Float[np.ndarray, "V 3"],
    polygons: Int[np.ndarray, "n corners"],
    numbers: Int[np.ndarray, " n"] | None = None,
) -> Int[np.ndarray, "n m 3"]:
    """Cut each polygon into triangles that share its first corner from which all other corners are visible.

    Raises:
        ValueError: a polygon has a vertex that does not exist, or no corner from which all other corners are visible.
    """
    if polygons.ndim != 2 or polygons.shape[1] < 3:
        raise ValueError(f"{file}: got faces of shape {polygons.shape}; expected at least 3 corners each")
    (n, size), low, high = polygons.shape, polygons.min(initial=0), polygons.max(initial=0)
    if low < 0 or high >= len(points):
        raise ValueError(f"{file}: a face refers to vertex {low if low < 0 else high}; expected 0 … {len(points) - 1}")
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
        raise ValueError(
            f"{file}: face {which} with {size} corners is not star-shaped about any corner. Cut it into triangles"
        )
    return found


_KEYWORD = re.compile(r"(ST)?C?N?OFF")
"""The first word of OFF files. ST, C and N mean that vertices have texture coordinates, colours and normals."""


def load_obj(file: Path) -> Loaded:
    """Load the vertices and faces of an OBJ file; ignore normals, texture coordinates, colours and groups."""
    vertices: list[list[float]] = []
    polygons: list[list[int]] = []
    with reading(file, "a readable OBJ mesh"):
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
    return _triangulated(file, vertices, polygons)


def load_off(file: Path) -> Loaded:
    """Load the vertices and faces of an OFF file; ignore colours, normals and texture coordinates."""
    with reading(file, "a readable OFF mesh"):
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
    return _triangulated(file, vertices, polygons)


def _triangulated(file: Path, vertices: list[list[float]], polygons: list[list[int]]) -> Loaded:
    if not polygons:
        raise ValueError(f"{file}: the mesh has no triangles; expected at least one face")
    points, order, triangles = np.array(vertices, np.float64).reshape(-1, 3), [], []
    for size in {len(polygon) for polygon in polygons}:
        which = np.flatnonzero([len(polygon) == size for polygon in polygons])
        order.append(np.repeat(which, size - 2))
        triangles.append(fans(file, points, np.array([polygons[i] for i in which]), which).reshape(-1, 3))
    return Loaded(points, np.concatenate(triangles)[np.argsort(np.concatenate(order), kind="stable")], {})
