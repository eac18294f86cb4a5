"""What a file of VTK declares against what it holds: VTK allocates by the former, and ends the process if it cannot."""

import base64
import lzma
import math
import re
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np

_BYTES = {f"{kind}{bits}": bits // 8 for kind in ("Int", "UInt") for bits in (8, 16, 32, 64)}
_BYTES |= {"Float32": 4, "Float64": 8}
_DECOMPRESSORS: dict[str, Callable[[bytes], bytes] | None] = {
    "vtkZLibDataCompressor": zlib.decompress,
    "vtkLZMADataCompressor": lzma.decompress,
    "vtkLZ4DataCompressor": None,  # VTK's own; here only its sizes are known
}
_CELLS = {name: f"NumberOf{name}" for name in ("Cells", "Verts", "Lines", "Strips", "Polys")}
_PLACE = {"Origin": 3, "Spacing": 3, "Direction": 9}

_TYPES = rb"(?:bit|(?:unsigned_)?(?:char|short|int|long)|vtkidtype|vtktypeu?int\d+|float|double|string)\b"
_COUNTS = re.compile(
    rb"(?:\b(?:DIMENSIONS|POINTS|CELLS|CELL_TYPES|VERTICES|LINES|POLYGONS|TRIANGLE_STRIPS|POINT_DATA|CELL_DATA|OFFSETS|CONNECTIVITY)"
    rb"|\b(?:FIELD|COLOR_SCALARS|LOOKUP_TABLE|TEXTURE_COORDINATES)\s+\S+|\bSCALARS\s+\S+\s+\w+)\s+((?:-?\d+\s+){1,3})"
    rb"|(?<![\w.-])(-?\d+\s+-?\d+)\s+" + _TYPES,
    re.IGNORECASE,
)

_LISTS = re.compile(rb"\b(?:VERTICES|LINES|POLYGONS|TRIANGLE_STRIPS)\s+(\d+)\s+(\d+)[ \t]*\n", re.IGNORECASE)


class _Source(NamedTuple):
    """Encoded data, and how."""

    content: bytes
    base64: bool

    def read(self, start: int, n: int) -> tuple[bytes, int]:
        """Return n bytes from a place in the encoded data, and the place behind them."""
        end = start + (4 * math.ceil(n / 3) if self.base64 else n)
        piece = self.content[start:end]
        if start < 0 or len(piece) < end - start:
            raise ValueError("the data of an array end early")
        return (base64.b64decode(piece, validate=True)[:n] if self.base64 else piece), end


def check_legacy(path: Path) -> None:
    """Raise ValueError where a legacy file declares more values than the file has bits, or fewer than none."""
    content = path.read_bytes()
    version = re.match(rb"# vtk DataFile Version (\d)\.\d\s*\n", content)
    if version is None:
        raise ValueError(f"it begins with {content[:30]!r}; expected the version, as in '# vtk DataFile Version 5.1'")
    for match in _COUNTS.finditer(content):
        numbers = [int(n) for n in (match[1] or match[2]).split()]
        # Numbers of tuples and components, or nodes along the axes, are of one array; others are each of one.
        of_one = match[2] is not None or match[0][:10].upper() == b"DIMENSIONS"
        if min(numbers) < 0 or (math.prod(numbers) if of_one else max(numbers)) > 8 * len(content):
            raise ValueError(f"{match[0][:60]!r} declares what {len(content)} bytes cannot hold")
    if int(version[1]) < 5:
        for match in _LISTS.finditer(content):
            _check_lists(content, match.end(), int(match[1]), int(match[2]))


def _check_lists(content: bytes, start: int, cells: int, size: int) -> None:
    """Raise ValueError unless numbers are lists, each behind its length, as VTK follows them without a look."""
    if b"ASCII" in content.split(b"\n", 3)[2].upper():
        numbers = [int(word) for word in content[start:].split(maxsplit=size)[:size]]
    else:
        numbers = np.frombuffer(content[start : start + 4 * size], ">i4").tolist()
    place = count = 0
    while place < len(numbers) and numbers[place] >= 0:
        place, count = place + 1 + numbers[place], count + 1
    if (place, count, len(numbers)) != (size, cells, size):
        raise ValueError(f"{cells} cells of {size} numbers are declared, and {count} of {place} there")


def check_xml(path: Path, kind: str) -> int:
    """Raise ValueError where a file does not hold the arrays that it declares, or declares what VTK has not.

    Args:
        path: ``.vti``, ``.vtp`` or ``.vtu``.
        kind: ``"ImageData"``, ``"PolyData"`` or ``"UnstructuredGrid"``.

    Returns:
        How many corners its cells have.
    """
    root, appended = _parse(path.read_bytes())
    if root.tag != "VTKFile" or root.get("type") != kind:
        raise ValueError(f"<{root.tag} type={root.get('type')!r}>; expected <VTKFile type={kind!r}>")
    compressor = root.get("compressor")
    if compressor is not None and compressor not in _DECOMPRESSORS:
        raise ValueError(f"compressor {compressor!r}; expected one of {', '.join(_DECOMPRESSORS)}")
    width = {"UInt32": 4, "UInt64": 8}[root.get("header_type", "UInt32")]
    order = {"LittleEndian": "little", "BigEndian": "big"}[root.get("byte_order", "LittleEndian")]
    data = root.find(kind)
    if data is None:
        raise ValueError(f"it has no {kind}")
    if kind == "ImageData":
        _check_place(data)
    corners = 0
    for array, count in _arrays(data, kind):
        form, name = array.get("format", "ascii"), array.get("Name")
        if form not in ("ascii", "binary", "appended"):
            raise ValueError(f"array {name!r} has the format {form!r}; expected ascii, binary or appended")
        text = (array.text or "") + "".join(child.tail or "" for child in array)  # children are remarks
        if form == "ascii":
            held = len(text.split())
            wanted = count
        else:
            source = appended if form == "appended" else _Source("".join(text.split()).encode(), True)
            start = int(array.get("offset", "")) if form == "appended" else 0
            if source is None:
                raise ValueError(f"array {name!r} is appended, and nothing is")
            held = _stored(source, start, width, order, compressor)
            wanted = None if count is None else count * {"String": 1, **_BYTES}.get(array.get("type", ""), 0)
        if name == "connectivity":
            corners += held if form == "ascii" else held // _BYTES[array.get("type", "")]
        # Of strings only the number is declared, and each ends with a zero.
        enough = wanted is None or held == wanted or (array.get("type") == "String" and held >= wanted)
        if not enough:
            unit = "values" if form == "ascii" else "bytes"
            raise ValueError(f"array {name!r} takes {wanted} {unit} by its size, and has {held}")
    return corners


def _parse(content: bytes) -> tuple[ElementTree.Element, _Source | None]:
    """Return the elements, and what is appended to them, which need not be text."""
    opening = re.search(rb"<AppendedData\s[^>]*>", content)
    if opening is None:
        return ElementTree.fromstring(content), None
    closing = content.rfind(b"</AppendedData>")
    root = ElementTree.fromstring(content[: opening.end()] + content[closing:])
    element = root.find("AppendedData")
    first = content.find(b"_", opening.end())
    encoding = None if element is None else element.get("encoding")
    if encoding not in ("raw", "base64") or first < 0 or content[opening.end() : first].strip():
        raise ValueError("the appended data have no encoding, or do not begin with an underscore")
    return root, _Source(content[first + 1 : closing], encoding == "base64")


def _arrays(data: ElementTree.Element, kind: str) -> Iterator[tuple[ElementTree.Element, int | None]]:
    """Return the arrays, and how many values each must have; None where others tell."""
    for array in data.iterfind("FieldData/*"):
        tuples = array.get("NumberOfTuples")
        yield array, None if tuples is None else _values(array, int(tuples))
    for piece in data.iterfind("Piece"):
        if kind == "ImageData":
            points, cells = _points_and_cells(_extent(piece, "Extent"))
        else:
            points = int(piece.get("NumberOfPoints", ""))
            cells = sum(int(piece.get(name, "0")) for name in _CELLS.values())
        for section in piece:
            for array in section:
                if section.tag in ("PointData", "Points"):
                    yield array, _values(array, points)
                elif section.tag == "CellData":
                    yield array, _values(array, cells)
                elif section.tag in _CELLS:
                    own = int(piece.get(_CELLS[section.tag], "0"))
                    yield array, own if array.get("Name") in ("offsets", "types") else None
                else:
                    raise ValueError(f"<{section.tag}> in a piece; VTK has none there")


def _values(array: ElementTree.Element, tuples: int) -> int:
    components = int(array.get("NumberOfComponents", "1"))
    if tuples < 0 or components < 0:
        raise ValueError(f"array {array.get('Name')!r} has {tuples} tuples of {components} components")
    return tuples * components


def _extent(element: ElementTree.Element, name: str) -> list[int]:
    numbers = [int(n) for n in element.get(name, "").split()]
    if len(numbers) != 6:
        raise ValueError(f"{name}: {element.get(name)!r}; expected six integers")
    return numbers


def _points_and_cells(extent: list[int]) -> tuple[int, int]:
    steps = [high - low for low, high in zip(extent[::2], extent[1::2], strict=True)]
    if min(steps) < 0:
        return 0, 0
    return math.prod(n + 1 for n in steps), math.prod(max(n, 1) for n in steps)


def _check_place(image: ElementTree.Element) -> None:
    """Raise ValueError unless the pieces fill the extent, and the image's place is what VTK knows."""
    unknown = set(image.keys()) - {"WholeExtent", *_PLACE}
    if unknown:
        raise ValueError(f"ImageData has {', '.join(sorted(unknown))}; expected WholeExtent, {', '.join(_PLACE)}")
    for name, n in _PLACE.items():
        numbers = [float(word) for word in image.get(name, " ".join("0" * n)).split()]
        if len(numbers) != n or not all(map(math.isfinite, numbers)):
            raise ValueError(f"{name}: {image.get(name)!r}; expected {n} finite numbers")
        lengths = [sum(x * x for x in numbers[i::3]) for i in range(3)]
        if name == "Direction" and image.get(name) and max(abs(s - 1) for s in lengths) > 1e-3:
            raise ValueError(f"Direction: {image.get(name)!r}; expected columns of length one")
    whole = _extent(image, "WholeExtent")
    pieces = [piece for each in image.iterfind("Piece") if _points_and_cells(piece := _extent(each, "Extent"))[0]]
    box = [(max if i % 2 else min)(ends) for i, ends in enumerate(zip(*pieces, strict=True))]
    cells = sum(_points_and_cells(piece)[1] for piece in pieces)
    if box != whole or cells != _points_and_cells(whole)[1]:
        raise ValueError(f"the pieces fill {box} with {cells} cells; expected the whole extent {whole}")


def _stored(source: _Source, start: int, width: int, order: str, compressor: str | None) -> int:
    """Return how many bytes the data of an array are, decompressed; the checksums of zlib and LZMA are compared."""

    def numbers(content: bytes) -> list[int]:
        return [int.from_bytes(content[i : i + width], order) for i in range(0, len(content), width)]  # type: ignore[arg-type]

    if compressor is None:
        (size,) = numbers(source.read(start, width)[0])
        source.read(start, width + size)
        return size
    count, full, last = numbers(source.read(start, 3 * width)[0])
    if count == 0:
        return 0
    head, start = source.read(start, (3 + count) * width)
    sizes = [full] * (count - 1) + [last or full]
    decompress = _DECOMPRESSORS[compressor]
    content, place = source.read(start, sum(numbers(head)[3:]))[0], 0
    for size, stored in zip(sizes, numbers(head)[3:], strict=True):
        if decompress is not None and len(decompress(content[place : place + stored])) != size:
            raise ValueError("a compressed block has another size than it declares")
        place += stored
    return sum(sizes)
