"""What meshio does not notice in a damaged mesh: numbers that are not those declared, and cells that it leaves out."""

import re
from pathlib import Path
from typing import Any

import numpy as np

_GMSH = re.compile(rb"\s*(?:\$Comments.*?\$EndComments\s*)?\$MeshFormat\s+(\S+)\s+([01])\s+([48])\b", re.DOTALL)
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
    """

    def __init__(self, path: Path) -> None:
        self._content, self._suffix = path.read_bytes(), path.suffix.lower()
        if self._suffix == ".msh":
            self._declared: tuple[int, ...] = _declared_by_gmsh(self._content)
        else:
            patterns = _COUNTS.get(self._suffix, ())
            self._declared = tuple(sum(map(int, re.findall(pattern, self._content))) for pattern in patterns)
        if max(self._declared, default=0) > 8 * len(self._content):
            raise ValueError(f"it declares {max(self._declared)} points or cells in {len(self._content)} bytes")

    def compare(self, mesh: Any) -> None:
        """Raise ValueError unless meshio found as many points and cells, and nothing follows them."""
        counts = (len(mesh.points), sum(len(block.data) for block in mesh.cells))
        if self._declared and self._declared[:2] != counts:
            what = "it declares {} points and {} cells, of which {} and {} are there"
            raise ValueError(what.format(*self._declared[:2], *counts))
        corners = sum(block.data.size for block in mesh.cells)
        lists = re.search(rb"\bCELLS\s+(\d+)\s+(\d+)", self._content) if self._suffix == ".vtk" else None
        if lists is not None:  # before version 5 with each cell's own number
            declared = int(lists[2]) - (0 if re.match(rb"# vtk DataFile Version [5-9]", self._content) else counts[1])
            if declared != corners:  # of a type that is damaged, meshio leaves some out
                raise ValueError(f"its cells declare {declared} corners, and have {corners} by their types")
        if self._suffix == ".ply":
            self._compare_ply(mesh)

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
        wanted, got = len(mesh.points) * point + sum(of_blocks), len(body.split() if ascii_ else body)
        if wanted != got:
            raise ValueError(
                f"its points and cells take {wanted} {'words' if ascii_ else 'bytes'}, and there are {got}"
            )


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
