"""Writing results and tensors, whole or not at all, with where they came from."""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from hks_jax.atomic import atomic_path
from hks_jax.domain.simplices import WORDS
from hks_jax.domain.simplicial_mesh import SimplicialMesh
from hks_jax.io import mesh, nifti, nrrd, vtk_image
from hks_jax.io.provenance import describe, describe_tensors
from hks_jax.io.repair import find_unsymmetric
from hks_jax.io.volume import TensorVolume
from hks_jax.optional import optional

SUFFIXES = (".npz", ".nii.gz", ".nii", ".nrrd", ".vti")
"""What results on a grid can be written as."""


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
    array = np.asarray(values)
    shape = (len(volume.vertices),) if isinstance(volume, SimplicialMesh) else volume.shape
    n = array.ndim - len(shape)
    if n not in (0, 1) or array.shape[n:] != shape:
        raise ValueError(f"values: got shape {array.shape}; expected {shape}, or n_times before it")
    extra = dict(extra or {})
    if isinstance(volume, SimplicialMesh):
        record = describe(None, provenance)
        if os.fspath(path).endswith(".npz"):
            cells = {WORDS[volume.triangulation.dimension].argument: volume.triangulation.cells}
            place = {"vertices": np.asarray(volume.vertices), **cells}
            return _write_npz(path, {name: array, **place, **extra, "provenance": record})
        return mesh.write(path, _by_time(name, array, n, extra), volume, record)
    record = describe(volume, provenance)
    if vtk_image.is_vtk_image(path):
        return vtk_image.write(path, _by_time(name, array, n, extra), volume, record, extra)
    if nifti.is_nifti(path) or nrrd.is_nrrd(path):
        others = sorted(extra.keys() - {"times"})
        if nifti.is_nifti(path) and others:
            raise ValueError(f"extra: got {', '.join(others)}; NIfTI has no place for more arrays. Write an .npz too")
        if volume.dimension == 2 and (nifti.is_nifti(path) or volume.affine is not None):
            array = np.expand_dims(array, n + volume.thin_axis)
        array = np.moveaxis(array, 0, -1) if n else array
        if nrrd.is_nrrd(path):
            return nrrd.write(path, array, volume, record, more=extra)
        if "times" in extra:
            _write_times(path, np.ravel(extra["times"]), name, volume)
        return _write_nifti(path, array, volume, record, name=name)
    slice_axis = {} if volume.slice_axis is None else {"slice_axis": volume.slice_axis}
    return _write_npz(path, {**_place(volume), name: array, **slice_axis, **extra, "provenance": record})


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
    unsymmetric = int(find_unsymmetric(volume).sum())
    if unsymmetric and (nrrd.is_nrrd(path) or nifti.is_nifti(path)):
        raise ValueError(
            f"volume: {unsymmetric} tensors are unsymmetric, and this format keeps one half of them only. Write their "
            "symmetric part (T + Tᵀ)/2, or an .npz or .vti"
        )
    if nrrd.is_nrrd(path):
        return nrrd.write_tensors(path, volume, describe_tensors(volume, "nrrd", "measurement", provenance))
    if vtk_image.is_vtk_image(path):
        return vtk_image.write_tensors(path, volume, describe_tensors(volume, "matrix", "world", provenance))
    if not nifti.is_nifti(path):
        record = describe_tensors(volume, "matrix", "voxel", provenance)
        units = {name: value for name in ("length_unit", "unit") if (value := getattr(volume, name))}
        return _write_npz(
            path, {"tensors": volume.tensors, **_place(volume), "frame": "voxel", **units, "provenance": record}
        )
    if volume.dimension != 3:
        raise ValueError(
            "volume: NIfTI has no 2×2 tensors; write the volume that the slice is of, or an .npz, .nrrd or .vti"
        )
    record = describe_tensors(volume, "nifti", "voxel", provenance)
    return _write_nifti(path, nifti.symmetric_matrix(volume), volume, record, symmetric=True)


def _by_time(name: str, array: np.ndarray, n: int, extra: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Return one array per time, by names that say which."""
    if n == 0:
        return {name: array}
    times = np.ravel(extra.get("times", ()))
    labels = [f"{name}_{i}" + (f"_t{times[i]:.6g}" if len(times) == len(array) else "") for i in range(len(array))]
    return dict(zip(labels, array, strict=True))


def _place(volume: TensorVolume) -> dict[str, Any]:
    optional = {"mask": volume.mask, "affine": volume.affine}
    given = {key: value for key, value in optional.items() if value is not None}
    return {"spacing": volume.spacing, "origin": volume.origin, **given}


def _write_nifti(
    path: str | os.PathLike[str],
    array: np.ndarray,
    volume: TensorVolume,
    record: str,
    *,
    name: str = "",
    symmetric: bool = False,
) -> Path:
    nib = optional("nibabel")
    if array.dtype not in (np.float32, np.float64):
        array = array.astype(np.uint8 if array.dtype == bool else np.float64)
    image = nib.Nifti1Image(array, volume.volume_affine)
    image.header.set_xyzt_units("mm")
    image.header.extensions.append(nib.nifti1.Nifti1Extension("comment", record.encode()))
    if symmetric:
        image.header.set_intent(nifti.SYMMETRIC_MATRIX, (3,))
    else:
        image.header["intent_name"] = name[:15].encode()
    with atomic_path(path) as temporary:
        nib.save(image, temporary)
    return Path(path)


def _write_times(path: str | os.PathLike[str], times: np.ndarray, name: str, volume: TensorVolume) -> None:
    """Write the times of an image's fourth axis beside it, as JSON."""
    file = Path(path)
    suffix = next(s for s in sorted(nifti.SUFFIXES, key=len, reverse=True) if file.name.lower().endswith(s))
    sidecar = file.with_name(file.name[: -len(suffix)] + ".json")
    content = {
        "Quantity": name,
        "Times": times.tolist(),
        "Sources": [Path(volume.source).name] if volume.source else [],
    }
    with atomic_path(sidecar) as temporary:
        Path(temporary).write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def _write_npz(path: str | os.PathLike[str], arrays: Mapping[str, Any]) -> Path:
    if not os.fspath(path).endswith(".npz"):
        raise ValueError(f"path: got {os.fspath(path)!r}; expected a name that ends in {', '.join(SUFFIXES)}")
    with atomic_path(path) as temporary, open(temporary, "wb") as stream:
        np.savez_compressed(stream, **arrays)
    return Path(path)
