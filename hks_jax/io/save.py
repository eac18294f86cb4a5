"""Writing results and tensors, whole or not at all, with where they came from."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from hks_jax.domain.simplices import WORDS
from hks_jax.domain.simplicial_mesh import SimplicialMesh
from hks_jax.io import mesh
from hks_jax.io.formats import WRITTEN, format_of
from hks_jax.io.volume import TensorVolume, describe
from hks_jax.io.vtk_image import by_time
from hks_jax.npz import write_npz


def save(
    path: str | os.PathLike[str],
    values: Float[Any, "*n_times_and_shape"],
    volume: TensorVolume | SimplicialMesh,
    *,
    name: str = "values",
    extra: Mapping[str, Any] | None = None,
    provenance: Mapping[str, Any] | None = None,
) -> Path:
    """Write scalars on the grid of a volume or slice, or at the vertices of a mesh: the format follows the suffix.

    ``.nii``, ``.nii.gz``: an image with the volume's affine, times along its fourth axis. A slice becomes an image one
    voxel thick at its place in space. NaN outside the mask is kept. The header has no room for times: those in `extra`
    are written beside the image, as BIDS does it, NAME.json with ``Times`` in the order of the fourth axis.

    ``.nrrd``: the same, times along the last axis; `extra` as text in the header.

    ``.vti``: one array of points per time, which is in its name, ``mask``, and `extra` as field data.

    ``.npz``: the arrays `name` (the values), ``spacing``, ``origin``, ``mask`` and ``affine`` (where there are any),
    ``slice_axis`` (for a slice), and those in `extra`.

    A mesh's ``.vtu``, ``.vtk``, ``.msh`` (Gmsh), and of triangles ``.ply``: the mesh, and one array per time, which is
    in its name. Its ``.npz``: `name`, ``vertices``, ``faces`` (of tetrahedra ``cells``), and those in `extra`.

    Every file says where it came from, in JSON: the version, the tensors' file with its SHA-256, order and frame, what
    was decided in reading it, and `provenance`. It is the comment extension of NIfTI; ``provenance`` in the others; for
    meshes, which have no place for it, a file beside it, the path with ``.json`` after it.

    The file is written beside its place and moved there in one step: it is never half there.

    Args:
        path: the file; missing folders are made.
        values: (*shape,) or (n_times, *shape); for a mesh (V,) or (n_times, V).
        volume: what the values belong to.
        name: what to call the values in the file.
        extra: more arrays, such as the times; for NIfTI the times alone.
        provenance: what else the file should say of its origin, such as the settings of the computation.

    Returns:
        The path.

    Raises:
        ValueError: an unknown suffix, or values of another shape.
        ImportError: an optional library is missing; says what to install.
    """
    file, array = Path(path), np.asarray(values)
    shape = (len(volume.vertices),) if isinstance(volume, SimplicialMesh) else volume.shape
    n = array.ndim - len(shape)
    if n not in (0, 1) or array.shape[n:] != shape:
        raise ValueError(f"values: got shape {array.shape}; expected {shape}, or n_times before it")
    extra = dict(extra or {})
    if not isinstance(volume, SimplicialMesh):
        write = format_of(file, WRITTEN).write
        assert write is not None
        write(file, array, volume, name, extra, describe(volume, provenance))
    elif file.name.lower().endswith(".npz"):
        cells = {WORDS[volume.triangulation.dimension].argument: volume.triangulation.cells}
        place = {"vertices": np.asarray(volume.vertices), **cells}
        write_npz(file, {name: array, **place, **extra, "provenance": describe(None, provenance)})
    else:
        mesh.write(file, by_time(name, array, n, extra), volume, describe(None, provenance))
    return file


def save_tensors(
    path: str | os.PathLike[str], volume: TensorVolume, *, provenance: Mapping[str, Any] | None = None
) -> Path:
    """Write the tensors of a volume so that `read_tensors` reads them back; the format follows the suffix.

    ``.nii``, ``.nii.gz``: a symmetric-matrix image (nx, ny, nz, 1, 6), xx xy yy xz yz zz along the voxel axes; only for
    volumes. Outside the mask the tensors are zero.

    ``.nrrd``: masked symmetric matrices, 3D or 2D, with the measurement frame. A slice loses its place in space.

    ``.vti``: nine components at the points, along the axes of space, and the mask. A slice has zeros across it.

    ``.npz``: the arrays that `read_tensors` documents.

    Where the tensors came from is said as by `save`, with the order and the frame that they have in the file: what is
    read back needs neither `order` nor `frame`. Units are kept but in VTK's files, which have none.

    Raises:
        ValueError: an unknown suffix; NIfTI for a slice; unsymmetric tensors in NIfTI or NRRD.
        ImportError: an optional library is missing; says what to install.
    """
    file = Path(path)
    write = format_of(file, WRITTEN).write_tensors
    assert write is not None
    write(file, volume, provenance)
    return file
