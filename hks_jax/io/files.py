"""Reading tensor volumes, and writing results and tensors, whole or not at all, with where they came from."""

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from hks_jax.checks import require_number
from hks_jax.domain.simplices import WORDS
from hks_jax.domain.simplicial_mesh import SimplicialMesh
from hks_jax.io import components, mesh, nifti
from hks_jax.io.formats import WRITTEN, format_of
from hks_jax.io.masks import read_mask
from hks_jax.io.repair import Repair, repair_tensors
from hks_jax.io.tensor_order import Frame, Order
from hks_jax.io.units import Unit, in_mm2_per_s
from hks_jax.io.volume import TensorVolume, as_mask, describe, digest
from hks_jax.io.vtk_image import by_time
from hks_jax.storage import write_npz


def read_tensors(
    path: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    order: Order | None = None,
    mask: str | os.PathLike[str] | Bool[np.ndarray, "*shape"] | None = None,
    *,
    frame: Frame | None = None,
    array: str | None = None,
    spacing: float | Sequence[float] | None = None,
    confidence: float = 0.5,
    repair: Repair | None = None,
    unit: Unit | None = None,
) -> TensorVolume:
    """Read a field of diffusion tensors.

    The file's name tells the format. A file that leaves the order of components or their axes open is refused with the
    choices named. Lengths are in mm where the file declares their unit; a note says what was converted.

    NIfTI: (nx, ny, nz, 1, 6) or (nx, ny, nz, 6), whose order the symmetric-matrix intent (code 1005) declares, or a
    BIDS sidecar, which may declare the frame, too; or six images of one component each, of which one may be given.

    MRtrix: (nx, ny, nz, 6) as its dwi2tensor writes them.

    NRRD: an axis of any of the format's kinds of matrix, 2D or 3D, at any place; or one of six (in the plane three)
    components whose `order` is given. The measurement frame is heeded. The affine's axes are right, anterior, superior
    where the file's space is patient-based.

    VTK (``.vti``, structured points in ``.vtk``): tensors of nine or six components at the points or cells, and an
    array ``mask``. Tensors without components across an image one voxel thick are 2×2.

    npz: the array ``tensors`` (nx, ny, 2, 2) or (nx, ny, nz, 3, 3), array axis a being coordinate a and tensor index a,
    or six (in the plane three) components whose order is given; and, optional, ``spacing`` (d,) = 1, ``origin`` (d,)
    = 0, ``mask`` (*shape,), ``affine`` (4, 4), ``order``, ``frame``. npy: the tensors alone.

    Args:
        path: the file, or six.
        order: ``"nifti"`` (xx xy yy xz yz zz), ``"fsl"`` (xx xy xz yy yz zz), ``"mrtrix"`` (xx yy zz xy xz yz) or
            ``"vtk"`` (xx yy zz xy yz xz); None: as the file declares. Not for whole matrices.
        mask: a file (see `read_mask`) or a bool array of the volume's shape; None: the file's own, or no mask.
        frame: the axes along which the file's components are: ``"voxel"``; ``"fsl"`` (voxel axes, the first reversed
            where the affine's determinant is positive); ``"world"`` (the axes of the file's space); ``"measurement"``
            (NRRD's measurement frame). None: the declared ones, or those of the order's programs: voxel axes
            for ``"nifti"``, ``"fsl"``, and ``"world"`` for ``"mrtrix"``, ``"vtk"``; for NumPy's files voxel axes.
        array: the name of the tensors' array in an npz or VTK file, where there are several.
        spacing: for NumPy's files without one.
        confidence: voxels of NRRD's masked kinds are inside where their confidence is larger.
        repair: what to do with tensors inside the mask that are not positive definite: see `repair_tensors`. None:
            nothing; a metric made of them is refused.
        unit: of the tensors, ``"mm2/s"``, ``"um2/ms"`` (10⁻³ mm²/s), ``"um2/s"``, ``"cm2/s"`` or ``"m2/s"``: they are
            converted to mm²/s. None: the numbers are taken as they are.

    Returns:
        The tensors along the voxel axes; `questions` asks about a frame or a unit that looks wrong.

    Raises:
        FileNotFoundError: no such file.
        ValueError: an unreadable or unknown kind of file; an order or a frame that is not declared; shapes that
            disagree; tensors that `repair` cannot mend.
        ImportError: an optional library is missing; says what to install.
    """
    require_number("confidence", confidence, above=-math.inf)
    if not isinstance(path, str | os.PathLike):
        if array is not None or spacing is not None:
            raise ValueError("array, spacing: they are for NumPy's and VTK's files; leave them out for six images")
        volume = components.read_tensors(list(path), order, frame)
    else:
        name, reader = os.fspath(path), format_of(path)
        if array is not None and "array" not in reader.options:
            raise ValueError(f"array: got {array!r}; only npz and VTK files have arrays by name")
        if spacing is not None and "spacing" not in reader.options:
            raise ValueError(f"spacing: {name} has its own; only NumPy's files may need one")
        if reader is nifti.FORMAT and components.is_one_of_six(path):
            volume = components.read_tensors(components.siblings(path), order, frame)
        else:
            given = {"array": array, "spacing": spacing, "confidence": confidence}
            volume = reader.read_tensors(name, order, frame, **{option: given[option] for option in reader.options})
            if not name.lower().endswith(".nhdr"):  # which is a header alone, and says nothing of the data beside it
                volume = replace(volume, digest=digest(name))
    if unit is not None:
        volume = in_mm2_per_s(volume, unit)
    if mask is not None:
        inside = as_mask("mask", mask) if isinstance(mask, np.ndarray) else read_mask(mask, volume.affine)
        if inside.shape != volume.shape:
            raise ValueError(f"mask: got shape {inside.shape}; expected the tensors' shape {volume.shape}")
        volume = volume.with_mask(inside)
    return volume if repair is None else repair_tensors(volume, repair)


def save(
    path: str | os.PathLike[str],
    values: Float[Any, "*n_times_and_shape"],
    volume: TensorVolume | SimplicialMesh,
    *,
    name: str = "values",
    extra: Mapping[str, Any] | None = None,
    provenance: Mapping[str, Any] | None = None,
) -> Path:
    """Write scalars on the grid of a volume or slice, or at the vertices of a mesh, in the format of the suffix.

    ``.nii``, ``.nii.gz``: an image with the volume's affine, times along its fourth axis. A slice becomes an image one
    voxel thick at its place in space. NaN outside the mask is kept. Times in `extra` are written beside the image, as
    BIDS does it, NAME.json with ``Times``.

    ``.nrrd``: the same, times along the last axis; `extra` as text in the header.

    ``.vti``: one array of points per time, which is in its name, ``mask``, and `extra` as field data.

    ``.npz``: the arrays `name` (the values), ``spacing``, ``origin``, ``mask`` and ``affine`` (where there are any),
    ``slice_axis`` (for a slice), and those in `extra`; of a mesh `name`, ``vertices``, ``faces`` (of tetrahedra
    ``cells``), and those in `extra`.

    ``.vtu``, ``.vtk``, ``.msh`` (Gmsh), and of triangles ``.ply``: the mesh, and one array per time.

    Every file says in JSON where it came from: the version, the tensors' file with its SHA-256, order and frame, what
    was decided in reading it, and `provenance`; of a mesh, but for npz, a file beside it, the path with ``.json`` after
    it. Files appear whole or not at all.

    Args:
        path: the file; missing folders are made.
        values: (*shape,) or (n_times, *shape); for a mesh (V,) or (n_times, V).
        volume: where the values are.
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

    The file says where the tensors came from, as `save` has it, and their order and frame: reading them back needs
    neither `order` nor `frame`. Units are kept but in VTK's files, which have none.

    Raises:
        ValueError: an unknown suffix; NIfTI for a slice; unsymmetric tensors in NIfTI or NRRD.
        ImportError: an optional library is missing; says what to install.
    """
    file = Path(path)
    write = format_of(file, WRITTEN).write_tensors
    assert write is not None
    write(file, volume, provenance)
    return file
