"""Read meshes in PLY: text and binary, with further elements and lists, such as edges and texture coordinates.

meshio refuses such elements and lists. trimesh renumbers vertices with texture coordinates, has no numbers at vertices,
and reads a mesh from files that are cut.
"""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from hks_jax.io.mesh_formats import Loaded, real_arrays, triangulated
from hks_jax.storage import UnsuitedError

_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
    **{f"{sign}int{8 * size}": f"{sign or 'i'}{size}" for sign in ("", "u") for size in (1, 2, 4, 8)},
}
"""NumPy's type for each type of PLY."""
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}
_CORNERS = ("vertex_indices", "vertex_index")
"""The names that programs give to the list of a face's corners."""


class Property(NamedTuple):
    """A property of an element: a number, or a list if `length` is not empty."""

    name: str
    type: str
    length: str  # the type of the list's length


class Rows(NamedTuple):
    """Rows of an element whose lists have the same lengths."""

    numbers: Int[np.ndarray, " n"]
    values: np.ndarray  # a structured array with one field per property


def load_ply(file: Path) -> Loaded:
    """Load vertices and faces with the numbers at them; ignore other elements and lists."""
    form, elements, body = _parsed(file.read_bytes())
    declared = {name: properties for name, _, properties in elements}
    corners = _require_mesh(declared)
    if form == "ascii":
        body = np.array(body.split(), np.float64).tobytes()
    end, found = 0, {}
    for name, count, properties in elements:
        found[name], end = _rows(body, end, count, properties, _ORDERS[form], form == "ascii")
    if body[end:].strip():
        raise ValueError(f"got {len(body)} bytes of elements; expected {end}, as the header declares")
    n_points, n_faces = (sum(len(rows.numbers) for rows in found.get(name, ())) for name in ("vertex", "face"))
    points, faces = (_columns(found.get(name, []), declared.get(name, [])) for name in ("vertex", "face"))
    vertices = np.stack([points.pop(axis) for axis in "xyz"], axis=-1).astype(np.float64)
    polygons = [(rows.numbers, _integers(rows.values[corners])) for rows in found.get("face", ())]
    loaded, face = triangulated(vertices, polygons)
    of_faces = {name: values[face] for name, values in real_arrays(faces, n_faces).items()}
    return loaded._replace(arrays=real_arrays(points, n_points), of_cells=of_faces)


def _require_mesh(declared: dict[str, list[Property]]) -> str:
    """Return the name of the list of a face's corners; raise UnsuitedError unless vertices and faces have all parts."""
    points, faces = declared.get("vertex", []), declared.get("face", [])
    corners = [p.name for p in faces if p.name in _CORNERS and p.length]
    if not {"x", "y", "z"} <= {p.name for p in points if not p.length} or not corners:
        has = "; ".join(
            f"{name}: {', '.join(f'list {p.name}' if p.length else p.name for p in there) or 'none'}"
            for name, there in (("vertex", points), ("face", faces))
        )
        raise UnsuitedError(
            f"got the properties {has}; expected x, y, z of each vertex and a list {' or '.join(_CORNERS)} of each "
            "face. A mesh of triangles is needed, not a cloud of points or triangle strips; export it as such"
        )
    return corners[0]


def _parsed(content: bytes) -> tuple[str, list[tuple[str, int, list[Property]]], bytes]:
    """Return the format, the elements with their numbers and properties, and the bytes after the header."""
    start = re.match(rb"ply[ \t]*(\r\n|\n|\r)", content)
    if start is None:
        raise ValueError("the file does not begin with 'ply'")
    end = re.search(rb"end_header[ \t]*" + start[1], content)
    if end is None:
        raise ValueError("the header does not end with 'end_header'")
    form, elements = "", list[tuple[str, int, list[Property]]]()
    for line in content[start.end() : end.start()].decode("latin-1").splitlines():
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["format", form, "1.0"] if form in _ORDERS:
                pass
            case ["element", name, count] if count.isdecimal():
                elements.append((name, int(count), []))
            case ["property", "list", length, kind, name] if elements and {length, kind} <= set(_TYPES):
                elements[-1][2].append(Property(name, _TYPES[kind], _TYPES[length]))
            case ["property", kind, name] if elements and kind in _TYPES:
                elements[-1][2].append(Property(name, _TYPES[kind], ""))
            case _:
                raise ValueError(f"got the header line {line[:60]!r}; expected a format, an element or a property")
    if not form:
        raise ValueError(f"the header has no format; expected {', '.join(_ORDERS)}")
    return form, elements, content[end.end() :]


def _rows(
    body: bytes, start: int, count: int, properties: list[Property], order: str, text: bool
) -> tuple[list[Rows], int]:
    """Return the rows of an element, grouped by the lengths of their lists, and where they end.

    In a text, all numbers are float64 in `body`.
    """
    types = [[np.dtype("f8" if text else order + kind) for kind in (p.type, p.length or p.type)] for p in properties]

    def record(lengths: tuple[int, ...]) -> np.dtype:
        fields: list[tuple] = []
        for p, (kind, of_length), length in zip(properties, types, lengths, strict=True):
            fields += [(f"{p.name} length", of_length), (p.name, kind, (length,))] if p.length else [(p.name, kind)]
        return np.dtype(fields)

    def measured(at: int) -> tuple[int, ...]:
        lengths = []
        for p, (kind, of_length) in zip(properties, types, strict=True):
            length = 1
            if p.length:
                length, at = int(np.frombuffer(body, of_length, 1, at)[0]), at + of_length.itemsize
                if not 0 <= length * kind.itemsize <= len(body) - at:
                    raise ValueError(f"got a list {p.name!r} of length {length}; expected a length from 0 that fits")
            lengths.append(length)
            at += length * kind.itemsize
        return tuple(lengths)

    if not count or not properties:
        return [], start
    lists, same = [p.name for p in properties if p.length], record(measured(start))
    if count * same.itemsize <= len(body) - start:  # all rows are likely to have the lengths of the first
        values = np.frombuffer(body, same, count, start)
        if all((values[f"{name} length"] == same[name].shape[0]).all() for name in lists):
            return [Rows(np.arange(count), values)], start + count * same.itemsize
    if not lists:
        raise ValueError(f"the file ends before the end of its {count} elements")
    at, places = start, dict[tuple[int, ...], list[tuple[int, int]]]()
    for number in range(count):
        lengths = measured(at)
        places.setdefault(lengths, []).append((number, at))
        at += record(lengths).itemsize
    if at > len(body):
        raise ValueError(f"the file ends before the end of its {count} elements")
    found = []
    for lengths, which in places.items():
        numbers, begins = np.array(which).T
        kind = record(lengths)
        chosen = np.frombuffer(body, np.uint8)[begins[:, None] + np.arange(kind.itemsize)]
        found.append(Rows(numbers, chosen.view(kind)[:, 0]))
    return found, at


def _columns(rows: list[Rows], properties: list[Property]) -> dict[str, np.ndarray]:
    """Return the properties that are numbers, (n,), in the type that the file declares."""
    columns = {p.name: np.empty(sum(len(each.numbers) for each in rows), p.type) for p in properties if not p.length}
    for each in rows:
        for name, column in columns.items():
            column[each.numbers] = each.values[name]
    return columns


def _integers(values: Float[np.ndarray, "n m"] | Int[np.ndarray, "n m"]) -> Int[np.ndarray, "n m"]:
    if not np.array_equal(values, np.rint(values)):
        raise ValueError("got fractional vertex indices; expected integers")
    return values.astype(np.int64)
