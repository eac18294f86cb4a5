"""What meshio does not notice in a damaged mesh, of Gmsh's formats above all: sizes, and points that it leaves out."""

import re
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int

from hks_jax.io.vtk_checks import check_legacy, check_xml

_SPARSE = 8
"""meshio makes a table as long as the largest tag of a node; up to so many entries for each byte of the file."""
_HEAD = re.compile(rb"\s*(?:\$Comments.*?\$EndComments\s*)?\$MeshFormat\s+(\S+)\s+([01])\s+([48])\b", re.DOTALL)
_CORNERS = {1: 2, 2: 3, 3: 4, 4: 4, 5: 8, 6: 6, 7: 5, 8: 3, 9: 6, 10: 9, 11: 10, 15: 1, 16: 8, 17: 20, 18: 15, 19: 13}
"""How many nodes Gmsh's types of elements have, up to second order."""


def check_gmsh(content: bytes) -> tuple[int, int]:
    """Raise ValueError unless nodes, elements and values are as many as declared, and the nodes can be numbered.

    Args:
        content: of a ``.msh`` file, format 2.2 or 4.1, text or binary.

    Returns:
        The declared numbers of nodes and elements.
    """
    head = _HEAD.match(content)
    if head is None or head[1] not in (b"2", b"2.2", b"4", b"4.1"):
        version = "no format of Gmsh's" if head is None else f"format {head[1].decode(errors='replace')}"
        raise ValueError(f"{version}; expected 2.2 or 4.1, as gmsh -format msh41 writes")
    text = head[2] == b"0"
    nodes, elements = (_Section(content, name, text, int(head[3])) for name in (b"Nodes", b"Elements"))
    if head[1].startswith(b"4"):
        n_nodes, tags = _nodes_in_blocks(nodes)
        n_elements = _elements_in_blocks(elements)
    else:
        n_nodes = nodes.line()
        tags = nodes.tags_of_rows(n_nodes)
        n_elements = elements.line()
        if text:
            elements.require_lines(n_elements)
        else:
            _elements_in_runs(elements, n_elements)
    if tags.size and not 0 < tags.min() <= tags.max() <= _SPARSE * len(content):
        raise ValueError(f"its nodes have the tags {tags.min()} … {tags.max()}")
    for data in re.finditer(rb"\$(?:Node|Element)Data[ \t]*\r?\n", content):
        _check_data(content[data.end() :].split(b"\n$End", 1)[0])
    return n_nodes, n_elements


def _nodes_in_blocks(section: "_Section") -> tuple[int, Int[np.ndarray, " n"]]:
    """Return the declared number of nodes, and their tags; format 4.1."""
    blocks, declared = section.sizes(4)[:2]
    tags: list[int] = []
    for _ in range(blocks):
        section.integers(3)
        (n,) = section.sizes(1)
        tags += section.sizes(n)
        section.skip(3 * n, 8)
    section.require_end()
    if len(tags) != declared:
        raise ValueError(f"it declares {declared} nodes, and its blocks have {len(tags)}")
    return declared, np.array(tags, np.int64)


def _elements_in_blocks(section: "_Section") -> int:
    """Return the declared number of elements, which is that of all blocks; format 4.1."""
    blocks, declared = section.sizes(4)[:2]
    there = 0
    for _ in range(blocks):
        kind = section.integers(3)[2]
        (n,) = section.sizes(1)
        section.skip(n * (1 + _corners(kind)), section.size)
        there += n
    section.require_end()
    if there != declared:
        raise ValueError(f"it declares {declared} elements, and its blocks have {there}")
    return declared


def _elements_in_runs(section: "_Section", declared: int) -> None:
    """Raise ValueError unless the runs of elements of one type are those declared; binary format 2.2."""
    there = 0
    while there < declared:
        kind, n, n_tags = section.integers(3)
        if n < 1 or n_tags < 0:
            raise ValueError(f"a run of {n} elements with {n_tags} tags")
        section.skip(n * (1 + n_tags + _corners(kind)), 4)
        there += n
    section.require_end()
    if there != declared:
        raise ValueError(f"it declares {declared} elements, of which {there} are there")


def _corners(kind: int) -> int:
    if kind not in _CORNERS:
        raise ValueError(f"elements of Gmsh's type {kind}; expected those of first order")
    return _CORNERS[kind]


def _check_data(section: bytes) -> None:
    """Raise ValueError where values at nodes or elements are declared for which there is no room."""
    lines = iter(section.split(b"\n"))
    for _ in range(3):  # names, real numbers, whole numbers: how many, and they
        listed = [next(lines, b"") for _ in range(min(int(next(lines, b"0")), len(section)))]
    numbers = [int(line) for line in listed]
    if len(numbers) < 3 or min(numbers[1:3]) < 0 or numbers[1] * numbers[2] > len(section):
        raise ValueError(f"values declared by the numbers {numbers[:3]} in {len(section)} bytes")


class _Section:
    """The numbers between ``$Name`` and ``$EndName``, one after the other; `size` is the bytes of a size or tag."""

    def __init__(self, content: bytes, name: bytes, text: bool, size: int) -> None:
        start = re.search(rb"\$" + name + rb"[ \t]*\r?\n", content)
        end = content.rfind(b"$End" + name)
        if start is None or end < start.end():
            raise ValueError(f"it has no section ${name.decode()}, or one without an end")
        self._content = content[start.end() : end]
        self._words = self._content.split() if text else []
        self._text, self._place, self.size = text, 0, size

    def skip(self, n: int, width: int) -> int:
        """Pass over n numbers of some bytes, and return where they begin."""
        start = self._place
        self._place += n if self._text else n * width
        if n < 0 or self._place > len(self._words if self._text else self._content):
            raise ValueError(f"it declares {n} numbers in a section that has not so many")
        return start

    def sizes(self, n: int) -> list[int]:
        """Return the next n sizes or tags."""
        return self._next(n, f"<u{self.size}")

    def integers(self, n: int) -> list[int]:
        """Return the next n integers, of four bytes."""
        return self._next(n, "<i4")

    def _next(self, n: int, dtype: str) -> list[int]:
        start = self.skip(n, np.dtype(dtype).itemsize)
        if self._text:
            return [int(word) for word in self._words[start : self._place]]
        return np.frombuffer(self._content[start : self._place], dtype).tolist()

    def line(self) -> int:
        """Return the number on the first line."""
        first = self._content.split(b"\n", 1)[0]
        self._place = 1 if self._text else len(first) + 1
        return int(first)

    def tags_of_rows(self, n: int) -> Int[np.ndarray, " n"]:
        """Return the tags of n nodes, each followed by its coordinates, which fill the section."""
        if self._text:
            self.skip(4 * n, 1)
            self.require_end()
            return np.array([int(word) for word in self._words[1::4]], np.int64)
        dtype = np.dtype("<i4, (3,)<f8")
        start = self.skip(n, dtype.itemsize)
        self.require_end()
        return np.frombuffer(self._content[start : start + n * dtype.itemsize], dtype)["f0"].astype(np.int64)

    def require_lines(self, n: int) -> None:
        """Raise ValueError unless n lines with something on them follow the first."""
        there = sum(1 for line in self._content.splitlines()[1:] if line.strip())
        if there != n:
            raise ValueError(f"it declares {n} elements, of which {there} are there")

    def require_end(self) -> None:
        """Raise ValueError unless nothing is left of the section."""
        left = self._words[self._place :] if self._text else self._content[self._place :].strip()
        if left:
            raise ValueError(f"{len(left)} {'numbers' if self._text else 'bytes'} follow what a section declares")


_COUNTS = {
    ".ply": (rb"element\s+vertex\s+(-?\d+)", rb"element\s+face\s+(-?\d+)"),
    ".vtk": (rb"\bPOINTS\s+(-?\d+)", rb"\bCELL_TYPES\s+(-?\d+)"),
    ".vtu": (rb"NumberOfPoints\s*=\s*[\"'](-?\d+)", rb"NumberOfCells\s*=\s*[\"'](-?\d+)"),
}
"""Where each format says how many points and cells it has; .stl, whose length meshio compares, does not."""

_BYTES = {
    name: size
    for names, size in (
        (b"char uchar int8 uint8", 1),
        (b"short ushort int16 uint16", 2),
        (b"int uint float int32 uint32 float32", 4),
        (b"double int64 uint64 float64", 8),
    )
    for name in names.split()
}
"""The types of .ply."""


class MeshChecks:
    """What a file declares, before meshio reads it and after.

    Args:
        path: the file.

    Raises:
        ValueError: more points or cells than the file has bits.
    """

    def __init__(self, path: Path) -> None:
        self._content, self._suffix = path.read_bytes(), path.suffix.lower()
        patterns = _COUNTS.get(self._suffix, ())
        self._declared = tuple(sum(map(int, re.findall(pattern, self._content))) for pattern in patterns)
        if self._suffix == ".msh":
            self._declared = check_gmsh(self._content)
        if max(self._declared, default=0) > 8 * len(self._content):
            raise ValueError(f"it declares {max(self._declared)} points or cells in {len(self._content)} bytes")
        self._corners: int | None = None
        if self._suffix == ".vtk":
            check_legacy(path)
            lists = re.search(rb"\bCELLS\s+(\d+)\s+(\d+)", self._content)
            if lists is not None:  # before version 5 with each cell's own number
                own = 0 if re.match(rb"# vtk DataFile Version [5-9]", self._content) else int(lists[1])
                self._corners = int(lists[2]) - own
        if self._suffix == ".vtu":
            self._corners = check_xml(path, "UnstructuredGrid")

    def compare(self, mesh: Any) -> None:
        """Raise ValueError unless meshio found as many points and cells, and nothing follows them."""
        counts = (len(mesh.points), sum(len(block.data) for block in mesh.cells))
        if self._declared and self._declared != counts:
            what = "it declares {} points and {} cells, of which {} and {} are there"
            raise ValueError(what.format(*self._declared, *counts))
        if self._suffix == ".ply":
            self._compare_ply(mesh)
        corners = sum(block.data.size for block in mesh.cells)
        if self._corners is not None and self._corners != corners:  # of a type that is damaged, meshio leaves some out
            raise ValueError(f"its cells declare {self._corners} corners, and have {corners} by their types")

    def _compare_ply(self, mesh: Any) -> None:
        end = re.search(rb"\bend_header\s*?\n", self._content)
        assert end is not None  # or meshio would not have read it
        head, body = self._content[: end.end()], self._content[end.end() :]
        ascii_ = b"format ascii" in head
        of_points, _, of_cells = head.partition(b"element face")
        lists = re.findall(rb"property\s+list\s+(\w+)\s+(\w+)", of_cells)
        if len(lists) != 1:
            return  # the lengths of further lists are nowhere else

        def size(name: bytes) -> int:
            return 1 if ascii_ else _BYTES[name]

        length, index = map(size, lists[0])
        scalar = re.compile(rb"property\s+(?!list)(\w+)")
        point, cell = (sum(map(size, scalar.findall(part))) for part in (of_points, of_cells))
        of_blocks = (len(b.data) * (length + index * b.data.shape[1] + cell) for b in mesh.cells)
        wanted = len(mesh.points) * point + sum(of_blocks)
        _same("words" if ascii_ else "bytes", wanted, len(body.split() if ascii_ else body))


def _same(unit: str, wanted: int, got: int) -> None:
    if wanted != got:
        raise ValueError(f"its points and cells take {wanted} {unit}, and there are {got}")
