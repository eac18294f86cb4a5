"""Triangle meshes through meshio, and VTK's polygonal data, which meshio leaves out, through VTK; both are optional."""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType

import numpy as np
from jaxtyping import Float, Int

from hks_jax.atomic import atomic_path
from hks_jax.domain.surface_mesh import SurfaceMesh
from hks_jax.io.nifti import existing
from hks_jax.io.vtk_image import holds_dataset, require_vtk

READ = (".vtk", ".vtu", ".vtp", ".ply", ".stl", ".obj", ".off")
WRITTEN = (".vtu", ".vtk", ".ply")
"""The formats with room for values at the vertices."""


def meshio() -> ModuleType:
    """Import meshio.

    Raises:
        ImportError: it is not installed; says how to get it.
    """
    try:
        import meshio
    except ImportError as error:
        raise ImportError(
            'reading and writing meshes needs meshio, which is not installed: pip install "hks-jax[mesh]"'
        ) from error
    return meshio


def read_mesh(path: str | os.PathLike[str], *, clean: bool = False) -> SurfaceMesh:
    """Read a triangle mesh: ``.vtk``, ``.vtu``, ``.ply``, ``.stl``, ``.obj``, ``.off`` through meshio.

    Polygonal data in ``.vtk`` and ``.vtp``, which meshio does not read, come through VTK. Quadrilaterals (there, all
    polygons) are cut into triangles; vertices keep their order. STL has no vertices, only corners: those at the same
    place become one vertex.

    Args:
        path: the file.
        clean: make one vertex of those at the same place (as at a texture's seams), then drop triangles without area
            and vertices without a triangle, all of which a `SurfaceMesh` refuses. The vertices are numbered anew, in
            the order of the file.

    Raises:
        FileNotFoundError: no such file.
        ValueError: an unknown kind of file, an unreadable one, other cells than triangles and quadrilaterals, or a mesh
            that `SurfaceMesh` refuses.
        ImportError: meshio, or for polygonal data VTK, is missing.
    """
    vertices, faces = _load(str(existing(path)))
    if clean:
        vertices, faces = _cleaned(vertices, faces)
    try:
        return SurfaceMesh(vertices, faces)
    except ValueError as error:
        remedy = "" if clean else ". clean=True merges vertices at one place and drops what has no area or no face"
        raise ValueError(f"{os.fspath(path)}: {error}{remedy}") from error


def write(
    path: str | os.PathLike[str], arrays: Mapping[str, Float[np.ndarray, " V"]], mesh: SurfaceMesh, record: str
) -> Path:
    """Write a mesh with values at its vertices, and a file ``path.json`` beside it that says where they came from."""
    name = os.fspath(path)
    suffix = Path(name).suffix.lower()
    if suffix not in WRITTEN:
        raise ValueError(f"path: got {name!r}; values at vertices are written as {', '.join(WRITTEN)} or .npz")
    library = meshio()
    cells = [("triangle", mesh.faces.astype(np.int32))]  # what PLY has room for
    whole = library.Mesh(np.asarray(mesh.vertices), cells, point_data={k: np.asarray(v) for k, v in arrays.items()})
    with atomic_path(name + ".json") as beside, atomic_path(name) as temporary:
        getattr(library, suffix[1:]).write(str(temporary), whole)
        beside.write_text(json.dumps(json.loads(record), indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
    return Path(path)


def _load(name: str) -> tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"]]:
    suffix = Path(name).suffix.lower()
    if suffix not in READ:
        raise ValueError(f"{name}: unknown kind of mesh; expected {', '.join(READ)}")
    if suffix == ".vtp" or (suffix == ".vtk" and holds_dataset(name, "POLYDATA")):
        return _polygonal(name)
    library = meshio()
    try:
        # The format's own reader: meshio.read ends the process where it cannot read a file.
        with np.errstate(over="ignore"):  # of a text's letters, which it takes for a number of triangles first
            read = getattr(library, suffix[1:]).read(name)
    except (library.ReadError, ValueError, KeyError, IndexError, AssertionError, OSError, EOFError) as error:
        raise ValueError(f"{name}: meshio cannot read it as {suffix} ({error or type(error).__name__})") from error
    points = np.asarray(read.points, np.float64)
    others = {block.type for block in read.cells} - {"triangle", "quad", "vertex", "line"}
    if others:
        raise ValueError(f"{name}: has {', '.join(sorted(others))} cells; expected triangles (or quadrilaterals)")
    faces = [_triangles(block.data) for block in read.cells if block.type in ("triangle", "quad")]
    if points.ndim != 2 or points.shape[1] not in (2, 3) or not faces:
        raise ValueError(f"{name}: has no triangles; expected a surface in two or three dimensions")
    flat = np.zeros((len(points), 3 - points.shape[1]))
    return np.concatenate([points, flat], axis=1), np.concatenate(faces).astype(np.int64)


def _polygonal(name: str) -> tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"]]:
    require_vtk()
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkFiltersCore import vtkTriangleFilter
    from vtkmodules.vtkIOLegacy import vtkPolyDataReader
    from vtkmodules.vtkIOXML import vtkXMLPolyDataReader

    reader = vtkPolyDataReader() if name.lower().endswith(".vtk") else vtkXMLPolyDataReader()
    errors: list[str] = []
    reader.AddObserver("ErrorEvent", lambda source, event: errors.append(event))
    reader.SetFileName(name)
    triangles = vtkTriangleFilter()
    triangles.PassLinesOff()
    triangles.PassVertsOff()
    triangles.SetInputConnection(reader.GetOutputPort())
    triangles.Update()
    surface = triangles.GetOutput()
    if errors or not surface.GetNumberOfPolys():
        raise ValueError(f"{name}: VTK finds no triangles in it; expected polygonal data, whole")
    points = np.asarray(vtk_to_numpy(surface.GetPoints().GetData()), np.float64)
    faces = np.asarray(vtk_to_numpy(surface.GetPolys().GetConnectivityArray()), np.int64)
    return points, faces.reshape(-1, 3)


def _triangles(cells: Int[np.ndarray, "n corners"]) -> Int[np.ndarray, "m 3"]:
    if cells.shape[1] == 3:
        return cells
    return np.stack([cells[:, [0, 1, 2]], cells[:, [0, 2, 3]]], axis=1).reshape(-1, 3)


def _cleaned(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"]]:
    _, first, inverse = np.unique(vertices + 0.0, axis=0, return_index=True, return_inverse=True)
    faces = first[inverse.ravel()[faces]]
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    longest = np.max([np.sum((p - q) ** 2, axis=1) for p, q in ((a, b), (b, c), (c, a))], axis=0)
    faces = faces[area > 1e-10 * longest]
    used, numbered = np.unique(faces, return_inverse=True)
    return vertices[used], numbered.reshape(faces.shape)
