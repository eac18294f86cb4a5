"""Read tensor volumes; write results and tensors atomically, with a record of their origin."""

import json
import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Bool, Float

from hks_jax.checks import require_number, require_real
from hks_jax.domain.simplicial_mesh import SimplicialMesh
from hks_jax.io import mesh, nifti
from hks_jax.io.formats import WRITTEN, format_of
from hks_jax.io.json_files import write_json
from hks_jax.io.masks import mask_on
from hks_jax.io.repair import Repair, repair_tensors
from hks_jax.io.tensor_order import Frame, Order
from hks_jax.io.units import Unit
from hks_jax.io.volume import TensorVolume, describe, digest
from hks_jax.storage import atomic_path

_NAME = re.compile(r"[A-Za-z0-9_.-]+")
"""The names of arrays that all formats can hold: PLY has no spaces, Gmsh no quotation marks, VTU no "<"."""
_CONFIDENCE = 0.5
"""The confidence above which a voxel is inside the mask, for NRRD's masked kinds."""
_PLACE = ("spacing", "origin", "mask", "affine", "slice_axis", "length_unit", "unit", "vertices", "faces", "cells")


def read_tensors(
    path: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    order: Order | None = None,
    mask: str | os.PathLike[str] | Bool[np.ndarray, "*shape"] | None = None,
    *,
    frame: Frame | None = None,
    array: str | None = None,
    spacing: float | Sequence[float] | None = None,
    confidence: float = _CONFIDENCE,
    repair: Repair | None = None,
    unit: Unit | None = None,
) -> TensorVolume:
    """Read a field of diffusion tensors.

    The suffix of the file determines the format. If neither the file nor an argument gives the order of the components
    or their axes, the function raises an error that lists the choices. If the file declares its unit of length, lengths
    are converted to mm, and a note reports the conversion.

    - NIfTI: an image (nx, ny, nz, 1, 6) or (nx, ny, nz, 6). The symmetric-matrix intent (code 1005) or a BIDS sidecar
      declares the order, and the sidecar may declare the frame and the unit. The tensors may also be in six images of
      one component each; pass the path of one image, or the paths of all six.
    - MRtrix: an image (nx, ny, nz, 6), as dwi2tensor writes it.
    - NRRD: an image with tensor components along any axis. The axis of the components has one of NRRD's 2D or 3D matrix
      kinds, or six entries (three for 2×2 tensors) in the given `order`. The measurement frame is applied. If the
      file's space is patient-based, the affine's axes are right, anterior, superior.
    - VTK (``.vti``, structured points in ``.vtk``): tensors of nine or six components at points or cells, and an
      optional array ``mask``. An image one voxel thick gives 2×2 tensors if the components across its plane are zero.
    - npz: the array ``tensors`` (nx, ny, 2, 2) or (nx, ny, nz, 3, 3), where array axis a runs along coordinate a. If
      `order` is given, ``tensors`` may also have the shape (nx, ny, 3) or (nx, ny, nz, 6). An npz may also contain
      ``spacing`` (d,), which is that of the affine or else 1 by default, ``origin`` (d,), which is 0 by default,
      ``mask`` (*shape,), ``affine`` (4, 4), ``slice_axis``, ``order`` and ``frame``. An npy file has only the tensors.

    Args:
        path: the path of the file, or the paths of six images of one component each.
        order: ``"nifti"`` (xx xy yy xz yz zz), ``"fsl"`` (xx xy xz yy yz zz), ``"mrtrix"`` (xx yy zz xy xz yz) or
            ``"vtk"`` (xx yy zz xy yz xz). None uses the declared order. Omit `order` for whole matrices.
        mask: a file (see `read_mask`) or a bool array of the volume's shape. None uses the tensor file's mask, if any.
        frame: the axes of the file's components: ``"voxel"``; ``"fsl"`` (voxel axes, where the first is reversed if the
            affine's determinant is positive); ``"world"`` (the axes of the file's space); ``"measurement"`` (NRRD's
            frame). None uses the declared axes, or else the convention of the order: voxel axes for ``"nifti"``, FSL's
            for ``"fsl"``, and ``"world"`` for ``"mrtrix"`` and ``"vtk"``. NumPy's files use voxel axes.
        array: the name of the tensors' array in an npz or VTK file with several arrays.
        spacing: the distance between voxels, for NumPy's files without ``spacing``.
        confidence: for NRRD's masked kinds, the confidence above which a voxel is inside the mask.
        repair: the repair of tensors inside the mask that are not positive definite; see `repair_tensors`. None leaves
            all tensors unchanged, but `hks_jax.TensorField` requires positive definite tensors.
        unit: the unit of the tensors in the file, ``"mm2/s"``, ``"um2/ms"`` (10⁻³ mm²/s), ``"um2/s"``, ``"cm2/s"`` or
            ``"m2/s"``, which is converted to mm²/s. If `unit` is None, a NIfTI file's BIDS sidecar may declare the unit
            (``Units``, such as ``"mm^2/s"``); without a declared unit, the numbers stay unchanged.

    Returns:
        The tensors along the voxel axes; `questions` reports a frame or a unit that looks wrong.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the file's kind is unknown or its content unreadable; the order or the frame is not declared; shapes
            disagree; `repair` cannot repair the tensors.
        ImportError: an optional library is missing; the message gives the command that installs it.

    Examples:
        >>> np.save(folder / "tensors.npy", field.tensors)
        >>> volume = hj.io.read_tensors(folder / "tensors.npy", spacing=1 / 8)
        >>> print(np.linalg.det(volume.tensors[4, 4]).round(3), volume.spacing)
        4.0 (0.125, 0.125)
    """
    require_number("confidence", confidence, above=-math.inf)
    paths = nifti.siblings(path) if isinstance(path, str | os.PathLike) else [os.fspath(each) for each in path]
    if len(paths) != 1:
        if array is not None or spacing is not None:
            raise ValueError("array, spacing: got one of them for six images, which do not need it. Leave it out")
        volume = nifti.read_components(paths, order, frame)
    else:
        (name,), reader = paths, format_of(paths[0])
        if array is not None and "array" not in reader.options:
            raise ValueError(f"array: got {array!r}, but only npz and VTK files have named arrays. Leave it out")
        if spacing is not None and "spacing" not in reader.options:
            raise ValueError(f"spacing: {name} declares its spacing; only NumPy's files may lack it. Leave it out")
        if confidence != _CONFIDENCE and "confidence" not in reader.options:
            raise ValueError(f"confidence: got {confidence}, but only NRRD's masked tensors have one. Leave it out")
        given = {"array": array, "spacing": spacing, "confidence": confidence}
        volume = reader.read_tensors(name, order, frame, **{option: given[option] for option in reader.options})
        if not name.lower().endswith(".nhdr"):  # the digest of a detached header would not identify the data
            volume = replace(volume, digest=digest(name))
    volume = nifti.with_units(volume, nifti.described_by(paths), unit)
    if mask is not None:
        volume = volume.with_mask(mask_on(volume.shape, volume.affine, mask))
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
    """Write scalars on the grid of a volume or slice, or at the vertices of a mesh; the suffix determines the format.

    - ``.nii``, ``.nii.gz``: an image with the volume's affine and times along the fourth axis. A slice is written as
      an image one voxel thick at its position in space. NaN outside the mask is kept. Times in `extra` are written to
      NAME.json beside the image as ``Times``, following BIDS, with the ``OrientationEncoding`` of scalars. A series has
      the ``RepetitionTime`` in `extra`, in s, as its fourth voxel size.
    - ``.nrrd``: the same image with times along the last axis, and `extra` as text in the header.
    - ``.vti``: point data with ``mask`` and one array per time, whose name contains the time; field data with `extra`.
    - ``.npz``: the values as the array `name`, and the arrays in `extra`. For a volume or slice, the npz also contains
      ``spacing`` and ``origin``, and ``mask``, ``affine``, ``slice_axis``, ``length_unit`` and ``unit`` if known. For a
      mesh, the npz also contains ``vertices``, and ``faces`` (triangles) or ``cells`` (tetrahedra).
    - ``.vtu``, ``.vtk``, ``.msh`` (Gmsh), and for triangles ``.ply``: the mesh and one array per time.
    - ``.gii`` (``.func.gii``, ``.shape.gii``), for triangles: one array per time in single precision, without the mesh.
      Connectome Workbench, freeview and nilearn show the arrays on the surface from which the mesh was read. The entry
      ``AnatomicalStructurePrimary`` of `provenance`, such as ``"CortexLeft"``, becomes that of the file.
    - ``.pvd``: a time series for ParaView, with the times in `extra`. The file lists one file for each time, which are
      written beside it (NAME.0.vti, … on grids and NAME.0.vtu, … on meshes).

    Every file contains a JSON record of its origin: the version, the tensors' file with its SHA-256, order and frame,
    the notes about its reading, and `provenance`. For a time series, and for a mesh except in npz and GIFTI, the record
    is in a second file, whose path is `path` with ``.json`` appended. Files are written atomically.

    Args:
        path: the file; missing folders are created.
        values: (*shape,) or (n_times, *shape); for a mesh (V,) or (n_times, V).
        volume: the volume, slice or mesh of the values.
        name: the name of the values in the file, of letters a–z, digits, "_", "-" and ".".
        extra: more arrays, such as the times; NIfTI allows only the times.
        provenance: more entries of the record, such as the settings of the computation.

    Raises:
        ValueError: the suffix is unknown, the values have another shape, or a name has other characters.
        ImportError: an optional library is missing; the message gives the command that installs it.

    Examples:
        >>> volume = hj.io.TensorVolume(np.array(field.tensors), field.grid.spacing, field.grid.origin)
        >>> path = hj.io.save(folder / "hks.npz", np.array(hj.hks(pairs, [0.5])), volume, name="hks")
        >>> np.array_equal(np.load(path)["hks"], hj.hks(pairs, [0.5]))
        True
    """
    if not isinstance(volume, TensorVolume | SimplicialMesh):
        raise TypeError(f"volume: got {type(volume).__name__}; expected a TensorVolume or a mesh")
    require_real("values", values)
    for argument, given in (("name", name), *(("extra", key) for key in extra or ())):
        if not _NAME.fullmatch(given):
            raise ValueError(f'{argument}: got the name {given!r}; expected letters a–z, digits, "_", "-" and "."')
    if name in (*_PLACE, *(extra or ())):
        raise ValueError(f"name: got {name!r}, which is the name of another array in the file; choose another name")
    file, array = Path(path), np.asarray(values)
    if array.dtype not in (np.float32, np.float64) and not file.name.lower().endswith(".npz"):
        array = array.astype(np.uint8 if array.dtype == bool else np.float64)
    shape = (len(volume.vertices),) if isinstance(volume, SimplicialMesh) else volume.shape
    n = array.ndim - len(shape)
    if n not in (0, 1) or array.shape[n:] != shape:
        raise ValueError(f"values: got shape {array.shape}; expected {shape}, or (n_times, *shape)")
    record = describe(None if isinstance(volume, SimplicialMesh) else volume, provenance)
    parts: list[tuple[Path, np.ndarray, dict[str, Any], str]]
    series, times = file.suffix.lower() == ".pvd", np.ravel((extra or {}).get("times", ()))
    if series:
        if n != 1 or len(times) != len(array):
            raise ValueError(
                f"extra: got {len(times)} times for values of shape {array.shape}; expected values (n_times, *shape) "
                'and extra={"times": …} with n_times numbers, as a time series has'
            )
        suffix, of_part = (".vtu", "") if isinstance(volume, SimplicialMesh) else (".vti", record)
        parts = [(file.with_name(f"{file.stem}.{i}{suffix}"), each, {}, of_part) for i, each in enumerate(array)]
    else:
        parts = [(file, array, dict(extra or {}), record)]
    for part, of_array, more, about in parts:
        if isinstance(volume, SimplicialMesh):
            mesh.write(part, of_array, volume, name, more, about)
        else:
            write = format_of(part, WRITTEN).write
            assert write is not None
            write(part, of_array, volume, name, more, about)
    if series:
        _write_collection(file, times, [part.name for part, *_ in parts], record)
    return file


def _write_collection(path: Path, times: Float[np.ndarray, " n_times"], parts: Sequence[str], record: str) -> None:
    """Write the list of the files of a time series, and a record of their origin."""
    collection = ElementTree.Element("VTKFile", type="Collection", version="0.1")
    entries = ElementTree.SubElement(collection, "Collection")
    for time, part in zip(times.tolist(), parts, strict=True):
        ElementTree.SubElement(entries, "DataSet", timestep=repr(time), part="0", file=part)
    with atomic_path(path) as temporary:
        ElementTree.ElementTree(collection).write(temporary, encoding="utf-8", xml_declaration=True)
    write_json(path.with_name(f"{path.name}.json"), json.loads(record))


def save_tensors(
    path: str | os.PathLike[str], volume: TensorVolume, *, provenance: Mapping[str, Any] | None = None
) -> Path:
    """Write the tensors of a volume in a format that `read_tensors` reads; the suffix determines the format.

    - ``.nii``, ``.nii.gz``: a symmetric-matrix image (nx, ny, nz, 1, 6) with xx xy yy xz yz zz along the voxel axes.
      The tensors are zero outside the mask. Slices cannot be written.
    - ``.nrrd``: masked symmetric matrices, 3D or 2D, and the measurement frame, but not the position of a slice.
    - ``.vti``: nine components at the points, along the axes of space, and the mask. A slice gets zeros for the
      components across its plane.
    - ``.npz``: the arrays that `read_tensors` documents.

    The file contains the record that `save` describes, and the order and frame of the tensors, so `read_tensors` needs
    neither `order` nor `frame`. Units are written except to VTK's files.

    Raises:
        ValueError: the suffix is unknown, or the format cannot hold the field: NIfTI holds no slices, and neither NIfTI
            nor NRRD holds unsymmetric tensors.
        ImportError: an optional library is missing; the message gives the command that installs it.

    Examples:
        >>> volume = hj.io.TensorVolume(np.array(field.tensors), field.grid.spacing, field.grid.origin)
        >>> path = hj.io.save_tensors(folder / "tensors.npz", volume)
        >>> np.array_equal(hj.io.read_tensors(path).tensors, volume.tensors)
        True
    """
    if not isinstance(volume, TensorVolume):
        raise TypeError(f"volume: got {type(volume).__name__}; expected a TensorVolume")
    file = Path(path)
    write = format_of(file, WRITTEN).write_tensors
    assert write is not None
    write(file, volume, provenance)
    return file
