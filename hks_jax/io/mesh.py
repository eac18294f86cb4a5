"""Read meshes of triangles or tetrahedra, clean them, and write them through meshio."""

import json
import os
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from hks_jax.accuracy import AccuracyWarning, warn_of_accuracy
from hks_jax.domain.simplices import WORDS, checked_cells, checked_mask, signed_measure
from hks_jax.domain.simplicial_mesh import SimplicialMesh, SurfaceMesh, TetMesh
from hks_jax.domain.triangulation import Triangulation
from hks_jax.io import cortex
from hks_jax.io.json_files import write_json
from hks_jax.io.mesh_formats import Loaded, load_obj, load_off, polygonal, through_meshio
from hks_jax.io.ply import load_ply
from hks_jax.io.vtk_image import by_time
from hks_jax.naming import argument
from hks_jax.optional import optional
from hks_jax.storage import UnsuitedError, atomic_path, reading, write_npz

READ = (".vtk", ".vtu", ".vtp", ".msh", ".ply", ".stl", ".obj", ".off", ".gii", ".gii.gz")
"""The suffixes of meshes. FreeSurfer's surfaces have no suffix and are recognised by their first bytes."""
WRITTEN = {".vtu": "vtu", ".vtk": "vtk", ".msh": "gmsh", ".ply": "ply"}
"""The suffixes of formats with values at vertices, and meshio's names of the formats. PLY has only triangles."""
_RESERVED = {".ply": ("x", "y", "z", "end_header"), ".vtk": ("METADATA",)}
"""The names that have another meaning in a format."""
_NEAR = 1e-8
"""The distance up to which vertices count as coincident, relative to the size of the mesh."""
_THIN = 1e-7
"""The height of a triangle, relative to its longest edge, up to which that edge is flipped."""


def read_mesh(
    path: str | os.PathLike[str], *, clean: bool = False, in_space: bool = False, mask: Any = None
) -> SurfaceMesh | TetMesh:
    """Read a mesh of tetrahedra or, if the file has none, of triangles.

    meshio reads ``.vtk``, ``.vtu``, Gmsh's ``.msh`` and ``.stl``; VTK reads polygonal data in ``.vtk`` and
    ``.vtp``; nibabel reads GIFTI (``.gii``) and FreeSurfer's surfaces (``lh.white``, …, recognised by their first
    bytes). The formats ``.ply``, ``.obj`` and ``.off`` need no library.

    Quadrilaterals are cut into triangles, as are all polygons in polygonal data, PLY, OBJ and OFF. Vertices keep their
    order. In STL, coincident corners of triangles become one vertex. Cells of lower dimension beside tetrahedra are
    ignored. Warnings report coincident vertices, as at the seams of a texture, because the surface is torn there, and
    vertices at which parts of the mesh touch without a common edge (of a solid, a common triangle).

    Args:
        path: the file.
        clean: whether to clean the mesh. Cleaning removes vertices that are not finite and their cells, merges vertices
            within 1e-8 of the mesh's size, flips the longest edge of triangles of nearly zero height, removes cells of
            zero area or volume, duplicate cells and unused vertices, and reverses tetrahedra of negative orientation.
            The kept vertices are renumbered in the order of the file. A warning lists what cleaning changed.
        in_space: whether to return the scanner coordinates that images have. FreeSurfer's coordinates are transformed
            by the axes and the centre (c_ras) of their volume, GIFTI's coordinates by the transformation in the file.
            Coordinates in all formats except FreeSurfer's and GIFTI stay unchanged.
        mask: the domain, as for `SurfaceMesh`: bool, one value for each vertex or for each cell of the file. Cells
            outside may be degenerate or NaN. With `clean`, the mask is that of the file before it is cleaned.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the kind of file is unknown, the file is unreadable or has other cells; the mesh has pieces that
            touch at coincident vertices; `SurfaceMesh` or `TetMesh` rejects the mesh; with `in_space`, a FreeSurfer
            file does not state the position of its volume.
        ImportError: meshio, nibabel, or for polygonal data VTK, is missing.

    Examples:
        >>> sphere = hj.examples.sphere_mesh(2)
        >>> path = hj.io.save(folder / "sphere.ply", np.array(sphere.vertices[:, 2]), sphere, name="height")
        >>> np.allclose(hj.io.read_mesh(path).vertices, sphere.vertices, atol=1e-6)
        True
    """
    return load_mesh(path, clean, in_space, None if mask is None else lambda n_vertices: mask).mesh


class MeshInFile(NamedTuple):
    """A mesh with the arrays of its file, by their place (``"vertices"``, and ``"faces"`` or ``"cells"``) and name."""

    mesh: SurfaceMesh | TetMesh
    cells: Int[np.ndarray, "n corners"]  # all cells, to which the arrays belong; the mesh has those inside the mask
    mask: Bool[np.ndarray, " n"] | None  # the cells inside
    arrays: dict[str, dict[str, Float[np.ndarray, "n *components"]]]
    written: tuple[str, ...]  # the suffixes of results on the mesh
    origin: dict[str, str]  # entries of their provenance


def load_mesh(
    path: str | os.PathLike[str],
    clean: bool = False,
    in_space: bool = False,
    inside: Callable[[int], Any] | None = None,
) -> MeshInFile:
    """Read a mesh and its arrays; see `read_mesh`. The function `inside` returns the mask for a number of vertices."""
    loaded, said, mask = _load(path, in_space), "", None
    if inside is not None:
        # Cleaning renumbers vertices and merges some, so the mask becomes one of cells before.
        n, d = len(loaded.vertices), loaded.cells.shape[1] - 1
        mask = checked_mask(inside(n), checked_cells(loaded.cells, n, d, masked=True), n, d)
    if clean:
        loaded, said, kept = _cleaned(loaded)
        mask = None if mask is None else mask[kept]
    maps = is_surface(Path(path)) and not clean  # cleaning may have renumbered the vertices
    make: Callable[..., SurfaceMesh | TetMesh] = SurfaceMesh if loaded.cells.shape[1] == 3 else TetMesh
    remedy = "" if clean else f". {argument('clean', True)} repairs some defects"
    try:
        mesh = make(loaded.vertices, loaded.cells, mask=mask)
    except ValueError as error:
        if str(error).startswith("mask: "):
            raise
        raise ValueError(f"{os.fspath(path)}: {error}{remedy}") from error
    if not clean:
        said, remedy = _require_joined(os.fspath(path), loaded, mesh.triangulation, remedy)
    if said:
        warn_of_accuracy(f"{os.fspath(path)}: {said}{remedy}", UserWarning if clean else AccuracyWarning)
    suffix = Path(path).suffix.lower()
    if suffix not in WRITTEN or (suffix == ".ply" and isinstance(mesh, TetMesh)):
        suffix = ".vtu"  # the file's format has no values at vertices
    origin = {cortex.STRUCTURE: loaded.structure} if maps and loaded.structure else {}
    return MeshInFile(mesh, loaded.cells, mask, _by_place(loaded), (suffix, cortex.MAPS) if maps else (suffix,), origin)


def read_mesh_arrays(
    path: str | os.PathLike[str], *, clean: bool = False, at: Literal["vertices", "faces", "cells"] = "vertices"
) -> dict[str, Float[np.ndarray, "n *components"]]:
    """Read the named arrays at the vertices or the cells of a mesh, such as tensors or the signatures of `save`.

    Only ``.vtk``, ``.vtu``, ``.vtp``, ``.msh`` and ``.ply`` have arrays; other files give an empty result. Arrays in
    ``.msh`` may lack values at some vertices or cells; there the result is NaN.

    Args:
        path: the file.
        clean: whether to clean the mesh, as for `read_mesh`. The arrays follow the numbering of the cleaned mesh.
        at: ``"vertices"``; or the cells of `read_mesh`, which are ``"faces"`` for triangles and ``"cells"`` for
            tetrahedra. All triangles of a polygon have the polygon's values.

    Returns:
        The real arrays in floating point, (n,) or (n, components). ``array.reshape(-1, 3, 3)`` gives tensors of nine
        components the shape (n, 3, 3). `SurfaceMesh.from_tensors` and `TetMesh.from_tensors` take such tensors with the
        same `at`.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the file is not a mesh, or unreadable, or has no such cells.
        ImportError: meshio, nibabel, or for polygonal data VTK, is missing.

    Examples:
        >>> sphere = hj.examples.sphere_mesh(2)
        >>> path = hj.io.save(folder / "sphere.ply", np.array(sphere.vertices[:, 2]), sphere, name="height")
        >>> np.allclose(hj.io.read_mesh_arrays(path)["height"], sphere.vertices[:, 2], atol=1e-6)
        True
    """
    loaded = _load(path)
    arrays = _by_place(_cleaned(loaded)[0] if clean else loaded)
    if at not in arrays:
        raise ValueError(f"at: got {at!r}, but the places of arrays in {os.fspath(path)} are {', '.join(arrays)}")
    return arrays[at]


def _by_place(loaded: Loaded) -> dict[str, dict[str, np.ndarray]]:
    """Return the arrays at the ``"vertices"``, and at the ``"faces"`` of a surface or the ``"cells"`` of a solid."""
    return {"vertices": dict(loaded.arrays), WORDS[loaded.cells.shape[1] - 1].argument: dict(loaded.of_cells)}


def is_mesh(path: Path) -> bool:
    """Return whether `read_mesh` reads a file, judged by the suffix or, without one, by the first bytes."""
    kind = _kind_of(path)
    return kind != "" and (kind != ".vtk" or (path.is_file() and b"STRUCTURED_POINTS" not in _head(path).upper()))


def is_surface(path: Path) -> bool:
    """Return whether a mesh is a GIFTI or a FreeSurfer surface, to which a file of maps belongs."""
    return _kind_of(path) in (".gii", _FREESURFER)


_FREESURFER = "FreeSurfer"


def _kind_of(path: Path) -> str:
    """Return the suffix of a mesh's format (``.vtp`` for polygonal data in ``.vtk``), `_FREESURFER`, or nothing."""
    name = path.name.lower()
    found = next((suffix for suffix in READ if name.endswith(suffix)), "")
    if found == ".vtk" and b"POLYDATA" in _head(path).upper():
        return ".vtp"
    if not found and _head(path).startswith(cortex.TRIANGLES):
        return _FREESURFER
    return found.removesuffix(".gz")


def _head(path: Path) -> bytes:
    """Return the beginning of a FreeSurfer surface or of a legacy VTK file; nothing for other files."""
    if not path.is_file():
        return b""
    with open(path, "rb") as stream:
        head = stream.read(1024)
    return head if head.startswith((cortex.TRIANGLES, b"# vtk DataFile")) else b""


def write(
    path: Path, array: Float[np.ndarray, "*n V"], mesh: SimplicialMesh, name: str, extra: Mapping[str, Any], record: str
) -> None:
    """Write a mesh with values at its vertices, and a record of their origin, if any, to the file ``path.json``.

    An npz file also has the arrays in `extra`. A GIFTI file has the values and no mesh. Both have the record.
    """
    suffix, dimension = path.suffix.lower(), mesh.triangulation.dimension
    if suffix == ".npz":
        place = {"vertices": np.asarray(mesh.vertices), WORDS[dimension].argument: mesh.triangulation.cells}
        return write_npz(path, {name: array, **place, **extra, "provenance": record})
    arrays, solid = by_time(name, array, array.ndim - 1, extra), dimension == 3
    if suffix == ".gii" and not solid:
        return cortex.write_maps(path, arrays, record)
    allowed = [s for s in (*WRITTEN, ".gii") if not (solid and s in (".ply", ".gii"))]
    if suffix not in allowed:
        what = "values at the vertices of tetrahedra" if solid else "values at vertices"
        raise ValueError(f"path: got {str(path)!r}; {what} can be written as {', '.join(allowed)} or .npz")
    if reserved := [key for key in arrays if key in _RESERVED.get(suffix, ())]:
        raise ValueError(f"name: got {reserved[0]!r}, which has another meaning in {suffix}; choose another name")
    library = optional("meshio")
    cells = [("tetra" if solid else "triangle", mesh.triangulation.cells.astype(np.int32))]  # PLY has no int64
    whole = library.Mesh(np.asarray(mesh.vertices), cells, point_data={k: np.asarray(v) for k, v in arrays.items()})
    with atomic_path(path) as temporary:
        getattr(library, WRITTEN[suffix]).write(str(temporary), whole)
        if record:
            write_json(path.with_name(f"{path.name}.json"), json.loads(record))


def _load(path: str | os.PathLike[str], in_space: bool = False) -> Loaded:
    """Return the content of a file."""
    readers: dict[str, tuple[str, Callable[[Path], Loaded]]] = {
        ".gii": ("a readable GIFTI surface", partial(cortex.load_gifti, in_space=in_space)),
        ".vtp": ("readable polygonal data", polygonal),
        ".obj": ("a readable OBJ mesh", load_obj),
        ".off": ("a readable OFF mesh", load_off),
        ".ply": ("a readable PLY mesh", load_ply),
        _FREESURFER: ("a readable FreeSurfer surface", partial(cortex.load_freesurfer, in_space=in_space)),
        "": ("a readable mesh", _unknown),
    }
    kind = _kind_of(Path(path))
    words, load = readers.get(kind, (f"a mesh that meshio can read as {kind}", through_meshio))
    with reading(path, words) as file:
        return load(file)


def _unknown(path: Path) -> Loaded:
    raise UnsuitedError(f"the kind of mesh is unknown; expected {', '.join(READ)}, or a FreeSurfer surface")


def _same_places(vertices: Float[np.ndarray, "V 3"]) -> Int[np.ndarray, " V"]:
    """Return for each vertex the first coincident vertex; a vertex that is not finite coincides with no other."""
    finite = np.flatnonzero(np.isfinite(vertices).all(axis=1))
    first = np.arange(len(vertices))
    if not finite.size:
        return first
    points = vertices[finite]
    # Equal vertices are merged before the search for close pairs, because n equal vertices form n(n − 1)/2 pairs.
    _, copy, place = np.unique(points + 0.0, axis=0, return_index=True, return_inverse=True)
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    pairs = cKDTree(points[copy]).query_pairs(_NEAR * size, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(copy),) * 2)
    labels = connected_components(graph, directed=False)[1][place.ravel()]
    _, least = np.unique(labels, return_index=True)
    first[finite] = finite[least[labels]]
    return first


def _require_joined(name: str, loaded: Loaded, apart: Triangulation, remedy: str) -> tuple[str, str]:
    """Return a warning if vertices of the domain coincide, or "", and its remedy; `apart` has the cells of the domain.

    Raises:
        ValueError: merging the vertices joins pieces of the mesh.
    """
    first = _same_places(np.where(apart.used[:, None], loaded.vertices, np.nan))
    doubled = int((first != np.arange(len(first))).sum())
    if not doubled:
        return "", ""
    merged = Triangulation(first[apart.cells], len(first))
    pieces, joined = (len(np.unique(each.labels[0][each.cells])) for each in (apart, merged))
    what = f"{doubled} of {len(first)} vertices coincide with another vertex"
    if (points := merged.pinched_vertices.size - apart.pinched_vertices.size) > 0:
        # Heat flows through a vertex that two parts share, but not through a point.
        remedy = f". Merging the vertices would leave {points} at which parts touch only in a point: move these apart"
    if joined < pieces:
        raise ValueError(
            f"{name}: vertices: {what}, so the mesh has {pieces} pieces that touch; expected {joined}, the number of "
            f"pieces after coincident vertices are merged{remedy}"
        )
    return f"{what}. The mesh is torn there, as at the seams of a texture, and no heat flows across", remedy


def _cleaned(loaded: Loaded) -> tuple[Loaded, str, Int[np.ndarray, " m"]]:
    """Return the mesh, cleaned as `read_mesh` documents, a text that lists the changes, and which cells are kept."""
    words = WORDS[loaded.cells.shape[1] - 1]
    first, n_cells, done = _same_places(loaded.vertices), len(loaded.cells), []

    def say(count: int, what: str) -> None:
        if count:
            done.append(f"{count} {what}")

    finite = np.isfinite(loaded.vertices).all(axis=1)
    say(int((~finite).sum()), "vertices with NaN or infinite coordinates removed")
    kept = np.flatnonzero(finite[loaded.cells].all(axis=1))
    cells = first[loaded.cells[kept]]
    say(n_cells - len(cells), f"{words.simplices} at such vertices removed")
    say(int((first != np.arange(len(first))).sum()), "vertices merged with a coincident vertex")
    flat = (np.diff(np.sort(cells, axis=1), axis=1) == 0).any(axis=1)
    if cells.shape[1] == 3:
        cells, gone, flipped = _without_thin(loaded.vertices, cells[~flat])
        kept = kept[~flat][~gone]
        say(flipped, "edges through a vertex flipped")
    else:
        inverted = signed_measure(loaded.vertices, cells)[0] < 0
        say(int(inverted.sum()), f"{words.simplices} of negative orientation reversed")
        cells = np.where(inverted[:, None], cells[:, [1, 0, 2, 3]], cells)[~flat]
        kept = kept[~flat]
    sound = signed_measure(loaded.vertices, cells)[1]
    say(int(flat.sum() + (~sound).sum()), f"{words.simplices} without {words.measure} removed")
    _, once = np.unique(np.sort(cells[sound], axis=1), axis=0, return_index=True)
    say(int(sound.sum()) - len(once), f"duplicate {words.simplices} removed")
    cells, kept = cells[sound][np.sort(once)], kept[sound][np.sort(once)]
    used, numbered = np.unique(cells, return_inverse=True)
    say(int((finite & (first == np.arange(len(first)))).sum()) - len(used), f"vertices without a {words.one} removed")
    arrays = {name: values[used] for name, values in loaded.arrays.items()}
    of_cells = {name: values[kept] for name, values in loaded.of_cells.items()}
    cleaned = Loaded(loaded.vertices[used], numbered.reshape(cells.shape), arrays, of_cells, loaded.structure)
    return cleaned, "; ".join(done), kept


def _without_thin(
    vertices: Float[np.ndarray, "V 3"], cells: Int[np.ndarray, "n 3"]
) -> tuple[Int[np.ndarray, "m 3"], Bool[np.ndarray, " n"], int]:
    """Flip the longest edge of each triangle of nearly zero height, or remove such a triangle at a boundary.

    Returns the triangles, which of the given triangles are removed, and the number of flips.
    """
    cells, gone, flipped = cells.copy(), np.zeros(len(cells), bool), 0
    corners = vertices[cells]
    lengths = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
    thin = signed_measure(vertices, cells)[0] <= _THIN * lengths.max(axis=1) ** 2
    for cell in np.flatnonzero(thin):
        corners = vertices[cells[cell]]
        longest = int(np.argmax(np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)))
        a, b, c = np.roll(cells[cell], -longest)
        beside = np.flatnonzero((cells == a).any(axis=1) & (cells == b).any(axis=1) & ~gone)
        beside = beside[beside != cell]
        if len(beside) == 1:
            other = cells[beside[0]]
            (d,) = other[(other != a) & (other != b)]
            cells[cell], cells[beside[0]] = (a, d, c), (d, b, c)
            flipped += 1
        elif not len(beside):
            gone[cell] = True
    return cells[~gone], gone, flipped
