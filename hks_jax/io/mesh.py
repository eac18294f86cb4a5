"""Meshes of triangles or tetrahedra in files: what reads which format, putting right, and writing through meshio."""

import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from hks_jax.accuracy import AccuracyWarning, warn_of_accuracy
from hks_jax.domain.simplices import WORDS, signed_measure
from hks_jax.domain.simplicial_mesh import SimplicialMesh, SurfaceMesh, TetMesh
from hks_jax.domain.triangulation import Triangulation
from hks_jax.io import cortex
from hks_jax.io.mesh_formats import Loaded, load_obj, load_off, polygonal, through_meshio
from hks_jax.io.tables import write_json
from hks_jax.io.vtk_image import holds_dataset
from hks_jax.optional import optional
from hks_jax.storage import atomic_path, existing

READ = (".vtk", ".vtu", ".vtp", ".msh", ".ply", ".stl", ".obj", ".off", ".gii", ".gii.gz")
"""The suffixes of meshes; FreeSurfer's surfaces, which have none of their own, are known by their first bytes."""
WRITTEN = {".vtu": "vtu", ".vtk": "vtk", ".msh": "gmsh", ".ply": "ply"}
"""The formats with room for values at the vertices, and what meshio calls them. PLY has triangles only."""
_NEAR = 1e-8
"""Distance, relative to the size of the mesh, up to which vertices lie at the same place."""
_THIN = 1e-7
"""Height of a triangle, relative to its longest edge, up to which the edge is flipped."""


def read_mesh(path: str | os.PathLike[str], *, clean: bool = False, in_space: bool = False) -> SurfaceMesh | TetMesh:
    """Read a mesh: tetrahedra, where the file has any, or else triangles.

    ``.vtk``, ``.vtu``, Gmsh's ``.msh``, ``.ply``, ``.stl`` through meshio; ``.obj`` and ``.off``; polygonal data in
    ``.vtk`` and ``.vtp`` through VTK; GIFTI (``.gii``) and FreeSurfer's surfaces (``lh.white``, … by their first bytes)
    through nibabel.

    Quadrilaterals (of polygonal data, OBJ and OFF all polygons) are cut into triangles; vertices keep their order. STL
    has only corners: those at the same place become one vertex. Cells of lower dimension beside tetrahedra are passed
    over. A warning says where vertices lie at the same place, as at the seams of a texture: the surface is torn there.

    Args:
        path: the file.
        clean: drop vertices that are not finite, with their cells; make one vertex of those at the same place (up to
            1e-8 of the mesh's size); flip the longest edges of triangles that have hardly a height; drop cells without
            area or volume, cells that are there twice and vertices without a cell; and turn tetrahedra round whose
            vertices are in the other order. The vertices are numbered anew, in the order of the file. A warning says
            what was done.
        in_space: take the coordinates of the scanner, in which images lie: FreeSurfer's are turned and moved by the
            axes and the centre of its volume (c_ras), GIFTI's by the transformation in the file. Others, and all
            without it, stay as they are.

    Raises:
        FileNotFoundError: no such file.
        ValueError: an unknown kind of file, an unreadable one, other cells, a mesh in pieces that touch at vertices at
            the same place, or one that `SurfaceMesh` or `TetMesh` refuses; with `in_space` a surface of FreeSurfer's
            that does not say where its volume lies.
        ImportError: meshio, nibabel, or for polygonal data VTK, is missing.
    """
    loaded, said = _load(path, clean, in_space)
    make: Callable[..., SurfaceMesh | TetMesh] = SurfaceMesh if loaded.cells.shape[1] == 3 else TetMesh
    remedy = "" if clean else ". clean=True puts right what it can: see read_mesh"
    try:
        mesh = make(loaded.vertices, loaded.cells)
        if not clean:
            said = _require_joined(loaded)
    except ValueError as error:
        raise ValueError(f"{os.fspath(path)}: {error}{remedy}") from error
    if said:
        warn_of_accuracy(f"{os.fspath(path)}: {said}{remedy}", UserWarning if clean else AccuracyWarning)
    return mesh


def read_mesh_arrays(
    path: str | os.PathLike[str], *, clean: bool = False
) -> dict[str, Float[np.ndarray, "V *components"]]:
    """Read the arrays at the vertices of a mesh, by name, such as tensors or the signatures that `save` writes.

    Formats that have such arrays are ``.vtk``, ``.vtu``, ``.vtp``, ``.msh`` and ``.ply``; others give none.

    Args:
        path: the file.
        clean: as for `read_mesh`: the arrays follow the numbering that it gives.

    Returns:
        The arrays of real numbers, floating point, (V,) or (V, components): symmetric tensors of nine components
        become (V, 3, 3) by ``array.reshape(-1, 3, 3)``.

    Raises:
        FileNotFoundError: no such file.
        ValueError: a file that is no mesh, or unreadable.
        ImportError: meshio, nibabel, or for polygonal data VTK, is missing.
    """
    return _load(path, clean)[0].arrays


def is_mesh(path: Path) -> bool:
    """Tell whether a file is one that `read_mesh` reads, by its suffix or, for want of one, its first bytes."""
    name = path.name.lower()
    if name.endswith(".vtk"):
        return path.is_file() and not holds_dataset(path, "STRUCTURED_POINTS")
    return name.endswith(READ) or cortex.is_freesurfer(path)


def write(path: Path, arrays: Mapping[str, Float[np.ndarray, " V"]], mesh: SimplicialMesh, record: str) -> None:
    """Write a mesh with values at its vertices, and a file ``path.json`` beside it that says where they came from."""
    suffix, solid = path.suffix.lower(), mesh.triangulation.dimension == 3
    allowed = [s for s in WRITTEN if not (solid and s == ".ply")]
    if suffix not in allowed:
        what = "values at the vertices of tetrahedra" if solid else "values at vertices"
        raise ValueError(f"path: got {str(path)!r}; {what} are written as {', '.join(allowed)} or .npz")
    library = optional("meshio")
    cells = [("tetra" if solid else "triangle", mesh.triangulation.cells.astype(np.int32))]  # what PLY has room for
    whole = library.Mesh(np.asarray(mesh.vertices), cells, point_data={k: np.asarray(v) for k, v in arrays.items()})
    with atomic_path(path) as temporary:
        getattr(library, WRITTEN[suffix]).write(str(temporary), whole)
        write_json(path.with_name(f"{path.name}.json"), json.loads(record))


def _load(path: str | os.PathLike[str], clean: bool, in_space: bool = False) -> tuple[Loaded, str]:
    """Return the mesh in a file, cleaned if asked to, and a text that lists the changes."""
    file = existing(path)
    name = file.name.lower()
    if name.endswith((".gii", ".gii.gz")):
        loaded = cortex.load_gifti(file, in_space)
    elif name.endswith(".vtp") or (name.endswith(".vtk") and holds_dataset(file, "POLYDATA")):
        loaded = polygonal(file)
    elif name.endswith(".obj"):
        loaded = load_obj(file)
    elif name.endswith(".off"):
        loaded = load_off(file)
    elif name.endswith(READ):
        loaded = through_meshio(file)
    elif cortex.is_freesurfer(file):
        loaded = cortex.load_freesurfer(file, in_space)
    else:
        raise ValueError(f"{file}: unknown kind of mesh; expected {', '.join(READ)}, or a surface of FreeSurfer's")
    return _cleaned(loaded) if clean else (loaded, "")


def _same_places(vertices: Float[np.ndarray, "V 3"]) -> Int[np.ndarray, " V"]:
    """Return for each vertex the first one at its place; one that is not finite is at a place of its own."""
    finite = np.flatnonzero(np.isfinite(vertices).all(axis=1))
    first = np.arange(len(vertices))
    if not finite.size:
        return first
    points = vertices[finite]
    # Copies first: in a soup of triangles there are many at each place, and pairs of them more yet.
    _, copy, place = np.unique(points + 0.0, axis=0, return_index=True, return_inverse=True)
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    pairs = cKDTree(points[copy]).query_pairs(_NEAR * size, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(copy),) * 2)
    labels = connected_components(graph, directed=False)[1][place.ravel()]
    _, least = np.unique(labels, return_index=True)
    first[finite] = finite[least[labels]]
    return first


def _require_joined(loaded: Loaded) -> str:
    """Return a warning if vertices lie at the same place, as at seams; the empty text if none do."""
    first = _same_places(loaded.vertices)
    doubled = int((first != np.arange(len(first))).sum())
    if not doubled:
        return ""
    pieces, joined = (
        len(np.unique(Triangulation(cells, len(first)).labels[0][cells]))
        for cells in (loaded.cells, first[loaded.cells])
    )
    what = f"{doubled} of {len(first)} vertices lie where another one lies"
    if joined < pieces:
        raise ValueError(
            f"vertices: {what}, and so the mesh falls into {pieces} pieces that touch; there would be {joined} if they "
            "were one vertex each"
        )
    return f"{what}: the mesh is torn there, as at the seams of a texture, and no heat goes across"


def _cleaned(loaded: Loaded) -> tuple[Loaded, str]:
    """Return the mesh cleaned as `read_mesh` documents it, and a text that lists the changes, empty without any."""
    words = WORDS[loaded.cells.shape[1] - 1]
    first, n_cells, done = _same_places(loaded.vertices), len(loaded.cells), []

    def say(count: int, what: str) -> None:
        if count:
            done.append(f"{count} {what}")

    finite = np.isfinite(loaded.vertices).all(axis=1)
    say(int((~finite).sum()), "vertices that are NaN or infinite removed")
    cells = first[loaded.cells[finite[loaded.cells].all(axis=1)]]
    say(n_cells - len(cells), f"{words.simplices} at them removed")
    say(int((first != np.arange(len(first))).sum()), "vertices merged with another one at the same place")
    flat = (np.diff(np.sort(cells, axis=1), axis=1) == 0).any(axis=1)
    if cells.shape[1] == 3:
        cells, flipped = _without_thin(loaded.vertices, cells[~flat])
        say(flipped, "edges flipped that passed through a vertex")
    else:
        inverted = signed_measure(loaded.vertices, cells)[0] < 0
        say(int(inverted.sum()), f"{words.simplices} turned round")
        cells = np.where(inverted[:, None], cells[:, [1, 0, 2, 3]], cells)[~flat]
    sound = signed_measure(loaded.vertices, cells)[1]
    say(int(flat.sum() + (~sound).sum()), f"{words.simplices} without {words.measure} removed")
    _, once = np.unique(np.sort(cells[sound], axis=1), axis=0, return_index=True)
    say(int(sound.sum()) - len(once), f"{words.simplices} removed that are there twice")
    cells = cells[sound][np.sort(once)]
    used, numbered = np.unique(cells, return_inverse=True)
    say(int((finite & (first == np.arange(len(first)))).sum()) - len(used), f"vertices without a {words.one} removed")
    arrays = {name: values[used] for name, values in loaded.arrays.items()}
    return Loaded(loaded.vertices[used], numbered.reshape(cells.shape), arrays), "; ".join(done)


def _without_thin(
    vertices: Float[np.ndarray, "V 3"], cells: Int[np.ndarray, "n 3"]
) -> tuple[Int[np.ndarray, "m 3"], int]:
    """Return triangles after flips at those with hardly a height, which go at a boundary, and the number of flips."""
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
    return cells[~gone], flipped
