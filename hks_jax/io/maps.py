"""Read maps, one or a series, at the voxels of an image or the vertices of a mesh."""

import os
from pathlib import Path

import numpy as np
from jaxtyping import Float

from hks_jax.domain.simplicial_mesh import SimplicialMesh
from hks_jax.io.cortex import load_maps
from hks_jax.io.formats import IMAGES
from hks_jax.io.masks import at_voxels, image_of
from hks_jax.io.mesh import WRITTEN, read_mesh_arrays
from hks_jax.io.volume import TensorVolume
from hks_jax.storage import existing, reading


def read_maps(path: str | os.PathLike[str], on: TensorVolume | SimplicialMesh) -> Float[np.ndarray, "n *shape"]:
    """Read maps for `hks_jax.decompose`: an image or a series (4D) on the voxels of `on`, or arrays at its vertices.

    The formats are NIfTI, MRtrix, NRRD and ``.npy``, and for meshes GIFTI (``.func.gii``, ``.shape.gii``), FreeSurfer's
    maps (``lh.thickness``, ``lh.curv``, …, recognised by their first bytes), ``.npy``, and all scalar arrays at the
    vertices of ``.vtu``, ``.vtk``, ``.msh`` and ``.ply``. In ``.npy`` the maps are (*shape), or (*shape, n) for a
    volume and (n, V) for a mesh. If both images have affines, each voxel of `on` must coincide with a voxel of the
    maps, and maps for a slice may cover the whole volume.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the kind of file is unknown, or the maps are on other voxels (the message has both affines), or have
            another number of vertices.
        ImportError: an optional library is missing; the message gives the command that installs it.

    Examples:
        >>> volume = hj.io.TensorVolume(np.array(field.tensors), field.grid.spacing, field.grid.origin)
        >>> np.save(folder / "series.npy", np.ones((9, 9, 20)))
        >>> hj.io.read_maps(folder / "series.npy", volume).shape
        (20, 9, 9)
    """
    name = os.fspath(path)
    if not isinstance(on, TensorVolume):
        return _at_vertices(existing(path), len(on.vertices))
    values, place = image_of(name, on.affine, tuple(suffix for suffix in IMAGES if suffix != ".npz"))
    if on.affine is not None and place is not None and values.ndim in (3, 4):
        try:
            values = at_voxels(name, values, np.linalg.solve(place, on.affine), on, "maps")
        except ValueError as error:
            affines = f"{place.round(4).tolist()} and {on.affine.round(4).tolist()}"
            raise ValueError(f"{error}. The affines of the maps and of the image are {affines}") from None
    d = on.dimension
    if values.shape[:d] != on.shape or values.ndim > d + 1:
        raise ValueError(f"{name}: got maps of shape {values.shape}; expected {on.shape}, or {(*on.shape, 'n')}")
    return np.moveaxis(values.reshape(*on.shape, -1), -1, 0).astype(np.float64)


def _at_vertices(path: Path, n: int) -> Float[np.ndarray, "m V"]:
    values, name = load_maps(path), path.name.lower()
    if values is None and name.endswith(".npy"):
        with reading(path, "a readable .npy file"):
            values = list(np.atleast_2d(np.load(path)))
    elif values is None and name.endswith(tuple(WRITTEN)):
        values = [array.ravel() for array in read_mesh_arrays(path).values() if array.size == len(array)]
    elif values is None:
        raise ValueError(
            f"{path}: the kind of file is unknown; expected .gii, .npy, {', '.join(WRITTEN)} with values at the "
            "vertices, or one of FreeSurfer's maps, such as lh.thickness"
        )
    if not values or any(array.shape != (n,) for array in values):
        shapes = ", ".join(sorted({str(array.shape) for array in values})) or "no arrays of values"
        raise ValueError(f"{path}: got {shapes}; expected one number for each of the {n} vertices")
    return np.stack(values).astype(np.float64)
