"""Meshes as meshio reads them, VTK's polygonal data, and OBJ and OFF files, whose variants it does not know.

Of a damaged mesh, meshio does not notice numbers that are not those declared, and cells that it leaves out.
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
    """What is in a file: places, triangles or tetrahedra, and arrays at the vertices."""

    vertices: Float[np.ndarray, "V 3"]
    cells: Int[np.ndarray, "n corners"]
    arrays: dict[str, Float[np.ndarray, "V *components"]]


_OF_SURFACES, _OF_BOUNDARIES = {"triangle", "quad"}, {"triangle", "quad", "line", "vertex"}


def through_meshio(path: Path) -> Loaded:
    """Load triangles or tetrahedra through meshio."""
    suffix = path.suffix.lower()
    library = optional("meshio")
    # Overflow is of a text's letters, which it takes for a number of triangles first.
    with reading(path, f"a mesh that meshio can read as {suffix}"), np.errstate(over="ignore"):
        content = path.read_bytes()
        declared = _declared(content, suffix)
        # The format's own reader: meshio.read ends the process where it cannot read a file.
        read = getattr(library, "gmsh" if suffix == ".msh" else suffix[1:]).read(str(path))
        _compare(content, suffix, declared, read)
        points = np.asarray(read.points, np.float64)
        tetrahedra = [_corners(block.data, 4) for block in read.cells if block.type == "tetra"]
        if points.ndim != 2 or points.shape[1] not in (2, 3):
            raise ValueError(f"points of shape {points.shape}")
        points = np.pad(points, ((0, 0), (0, 3 - points.shape[1])))
        triangles = [_triangles(block.data, points) for block in read.cells if block.type in _OF_SURFACES]
        arrays = _real_arrays(read.point_data, len(points))
    others = {block.type for block in read.cells} - _OF_BOUNDARIES - {"tetra"}
    if others:
        raise ValueError(
            f"{path}: has {', '.join(sorted(others))} cells; expected triangles (or quadrilaterals), or tetrahedra"
        )
    blocks = tetrahedra or triangles
    if not blocks:
        raise ValueError(f"{path}: has no triangles and no tetrahedra; expected a mesh in two or three dimensions")
    return Loaded(points, np.concatenate(blocks).astype(np.int64), arrays)


_GMSH = re.compile(rb"\s*(?:\$Comments.*?\$EndComments\s*)?\$MeshFormat\s+(\S+)\s+([01])\s+([48])\b", re.DOTALL)
_COUNTS = {
    ".ply": (rb"element\s+vertex\s+(-?\d+)", rb"element\s+face\s+(-?\d+)"),
    ".vtk": (rb"\bPOINTS\s+(-?\d+)", rb"\bCELL_TYPES\s+(-?\d+)"),
    ".vtu": (rb"NumberOfPoints\s*=\s*[\"'](-?\d+)", rb"NumberOfCells\s*=\s*[\"'](-?\d+)"),
}
"""Where each format says how many points and cells it has; .stl, whose length meshio compares, does not."""

_PLY = {"char": 1, "uchar": 1, "short": 2, "ushort": 2, "int": 4, "uint": 4, "float": 4, "double": 8}
"""The bytes of the types of .ply that NumPy calls otherwise."""


def _declared(content: bytes, suffix: str) -> tuple[int, ...]:
    """Return the numbers of points and cells that a file declares, and for Gmsh the largest tag of a point."""
    patterns = _COUNTS.get(suffix, ())
    declared = tuple(sum(map(int, re.findall(pattern, content))) for pattern in patterns)
    if suffix == ".msh":
        declared = _declared_by_gmsh(content)
    if max(declared, default=0) > 8 * len(content):
        raise ValueError(f"it declares {max(declared)} points or cells in {len(content)} bytes")
    return declared


def _compare(content: bytes, suffix: str, declared: tuple[int, ...], mesh: Any) -> None:
    """Raise ValueError unless meshio found as many points and cells as are declared, and nothing follows them."""
    counts = (len(mesh.points), sum(len(block.data) for block in mesh.cells))
    if declared and declared[:2] != counts:
        what = "it declares {} points and {} cells, of which {} and {} are there"
        raise ValueError(what.format(*declared[:2], *counts))
    corners = sum(block.data.size for block in mesh.cells)
    lists = re.search(rb"\bCELLS\s+(\d+)\s+(\d+)", content) if suffix == ".vtk" else None
    if lists is not None:  # before version 5 with each cell's own number
        listed = int(lists[2]) - (0 if re.match(rb"# vtk DataFile Version [5-9]", content) else counts[1])
        if listed != corners:  # of a type that is damaged, meshio leaves some out
            raise ValueError(f"its cells declare {listed} corners, and have {corners} by their types")
    if suffix == ".ply":
        _compare_ply(content, mesh)


def _compare_ply(content: bytes, mesh: Any) -> None:
    head, _, body = re.split(rb"(\bend_header\s*?\n)", content, maxsplit=1)
    ascii_ = b"format ascii" in head
    of_points, _, of_cells = head.partition(b"element face")
    lists = re.findall(rb"property\s+list\s+(\w+)\s+(\w+)", of_cells)
    if len(lists) != 1:
        return  # the lengths of further lists are nowhere else

    def size(name: bytes) -> int:
        return 1 if ascii_ else _PLY.get(name.decode()) or np.dtype(name.decode()).itemsize

    length, index = map(size, lists[0])
    scalar = re.compile(rb"property\s+(?!list)(\w+)")
    point, cell = (sum(map(size, scalar.findall(part))) for part in (of_points, of_cells))
    of_blocks = (len(b.data) * (length + index * b.data.shape[1] + cell) for b in mesh.cells)
    wanted, got = len(mesh.points) * point + sum(of_blocks), len(body.split() if ascii_ else body)
    if wanted != got:
        raise ValueError(f"its points and cells take {wanted} {'words' if ascii_ else 'bytes'}, and there are {got}")


def _declared_by_gmsh(content: bytes) -> tuple[int, int, int]:
    """Return the numbers of nodes and elements, and the largest tag of a node: meshio makes a table as long as that."""
    head = _GMSH.match(content)
    if head is None or head[1] not in (b"2", b"2.2", b"4", b"4.1"):
        version = "no format of Gmsh's" if head is None else f"format {head[1].decode(errors='replace')}"
        raise ValueError(f"{version}; expected 2.2 or 4.1, as gmsh -format msh41 writes")
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
            if there != declared:  # meshio passes over the rest
                raise ValueError(f"it declares {declared} nodes or elements, and has {there} lines for them")
        rows, node = nodes.partition(b"\n")[2], np.dtype("<i4, (3,)<f8")
        tags = map(int, rows.split()[::4]) if text else np.frombuffer(rows[: n_nodes * node.itemsize], node)["f0"]
        largest = int(max(tags, default=0))
    return n_nodes, n_elements, largest


def _section(content: bytes, name: bytes) -> bytes:
    start, end = re.search(rb"\$" + name + rb"[ \t]*\r?\n", content), content.rfind(b"$End" + name)
    if start is None or end < start.end():
        raise ValueError(f"it has no section ${name.decode()}, or one without an end")
    return content[start.end() : end]


def polygonal(path: Path) -> Loaded:
    """Load polygonal data through VTK, its polygons cut into triangles."""
    with reading(path, "readable polygonal data"):
        data = through_vtk(path)
        if "faces" not in data:
            raise ValueError(f"it holds {data['kind']}")
        points = data["points"].astype(np.float64)
    arrays = {key.removeprefix("point:"): values for key, values in data.items() if key.startswith("point:")}
    return Loaded(points, data["faces"].astype(np.int64), _real_arrays(arrays, len(points)))


def _real_arrays(named: dict[str, Any], n_points: int) -> dict[str, Float[np.ndarray, "V *components"]]:
    """Return the arrays of real numbers that have a row for each point, but for the tags that Gmsh's files have."""
    arrays = {key: np.asarray(values) for key, values in named.items() if not key.startswith("gmsh:")}
    return {
        key: values.astype(np.result_type(values.dtype, np.float32))
        for key, values in arrays.items()
        if values.ndim and len(values) == n_points and values.dtype.kind in "fiub"
    }


def _corners(cells: Int[np.ndarray, "n corners"], corners: int) -> Int[np.ndarray, "n corners"]:
    if cells.ndim != 2 or cells.shape[1] != corners:
        raise ValueError(f"cells of {corners} corners with the shape {cells.shape}")
    return cells


def _triangles(cells: Int[np.ndarray, "n corners"], points: Float[np.ndarray, "V 3"]) -> Int[np.ndarray, "m 3"]:
    if cells.ndim != 2 or cells.shape[1] not in (3, 4):
        raise ValueError(f"triangles or quadrilaterals of shape {cells.shape}")
    if cells.shape[1] == 3:
        return cells
    if cells.size and not 0 <= cells.min() <= cells.max() < len(points):
        raise ValueError(f"a quadrilateral has the corner {cells.max()} of {len(points)} points")
    cut = fans(points, cells)
    if (cut < 0).any():
        raise ValueError("a quadrilateral whose sides cross")
    return cut.reshape(-1, 3)


def fans(points: Float[np.ndarray, "V 3"], polygons: Int[np.ndarray, "n corners"]) -> Int[np.ndarray, "n m 3"]:
    """Return polygons cut into triangles around the first corner that sees all others; −1 where none does."""
    n, size = polygons.shape
    found = np.full((n, size - 2, 3), -1)
    for first in reversed(range(size)):
        turned = np.roll(polygons, -first, axis=1)
        fan = np.stack([np.broadcast_to(turned[:, :1], (n, size - 2)), turned[:, 1:-1], turned[:, 2:]], axis=-1)
        a, b, c = np.moveaxis(points[fan], 2, 0)
        with np.errstate(over="ignore", invalid="ignore"):  # of vertices that are far away or not finite
            normals = np.cross(b - a, c - a)
            along = np.einsum("nmx,nx->nm", normals, normals.sum(axis=1))
        seen = ~(along < 0).any(axis=1)
        found[seen] = fan[seen]
    return found


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
                f"it declares {n_vertices} vertices and {n_faces} faces, and has {len(rest)} lines of them"
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
                f"{file}: face {bad} of {size} corners is not convex; expected triangles: cut it into some"
            )
        order.append(np.repeat(which, size - 2))
        triangles.append(cut.reshape(-1, 3))
    return Loaded(points, np.concatenate(triangles)[np.argsort(np.concatenate(order), kind="stable")], {})
