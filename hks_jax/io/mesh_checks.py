"""What meshio does not notice in a damaged mesh: sizes that no file has, and points or cells that it leaves out."""

import re
from pathlib import Path
from typing import Any

from hks_jax.io.gmsh_checks import check_gmsh
from hks_jax.io.vtk_checks import check_legacy, check_xml

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
