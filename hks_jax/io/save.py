"""Writing results and tensors, whole or not at all."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from hks_jax.atomic import atomic_path
from hks_jax.io import nifti
from hks_jax.io.tensor_order import pack
from hks_jax.io.volume import TensorVolume


def save(
    path: str | os.PathLike[str],
    values: Float[Any, "*n_times_and_shape"],
    volume: TensorVolume,
    *,
    name: str = "values",
    extra: Mapping[str, Any] | None = None,
) -> Path:
    """Write scalars on the grid of a volume or slice: the format follows the suffix.

    ``.nii``, ``.nii.gz``: an image with the volume's affine, times along its fourth axis. A slice becomes an image one
    voxel thick at its place in space. NaN outside the mask is kept.

    ``.npz``: the arrays `name` (the values), ``spacing``, ``origin``, ``mask`` and ``affine`` (where there are any),
    ``slice_axis`` (for a slice), and those in `extra`.

    The file is written beside its place and moved there in one step: it is never half there.

    Args:
        path: the file; missing folders are made.
        values: (*shape,) or (n_times, *shape).
        volume: what the values belong to.
        name: what to call the values in the file.
        extra: more arrays for the npz, such as the times; not for NIfTI.

    Returns:
        The path.

    Raises:
        ValueError: an unknown suffix, or values of another shape.
        ImportError: NIfTI without nibabel.
    """
    array = np.asarray(values)
    n = array.ndim - volume.dimension
    if n not in (0, 1) or array.shape[n:] != volume.shape:
        raise ValueError(f"values: got shape {array.shape}; expected {volume.shape}, or n_times before it")
    if nifti.is_nifti(path):
        if extra:
            raise ValueError(f"extra: got {', '.join(extra)}; NIfTI has no place for more arrays. Write an .npz too")
        if volume.dimension == 2:
            array = np.expand_dims(array, n + volume.thin_axis)
        return _write_nifti(path, np.moveaxis(array, 0, -1) if n else array, volume, name=name)
    placement = {} if volume.slice_axis is None else {"slice_axis": volume.slice_axis}
    return _write_npz(path, {name: array, **placement, **(extra or {})}, volume)


def save_tensors(path: str | os.PathLike[str], volume: TensorVolume) -> Path:
    """Write the tensors of a volume so that `read_tensors` reads them back; the format follows the suffix.

    ``.nii``, ``.nii.gz``: a symmetric-matrix image (nx, ny, nz, 1, 6), xx xy yy xz yz zz along the voxel axes; only for
    volumes. ``.npz``: the arrays that `read_tensors` documents.

    Raises:
        ValueError: an unknown suffix, or NIfTI for a slice.
        ImportError: NIfTI without nibabel.
    """
    if not nifti.is_nifti(path):
        return _write_npz(path, {"tensors": volume.tensors}, volume)
    if volume.dimension != 3:
        raise ValueError("volume: NIfTI has no 2×2 tensors; write the volume that the slice is of, or an .npz")
    return _write_nifti(path, pack(volume.tensors, "nifti")[..., None, :], volume, symmetric=True)


def _write_nifti(
    path: str | os.PathLike[str],
    array: np.ndarray,
    volume: TensorVolume,
    *,
    name: str = "",
    symmetric: bool = False,
) -> Path:
    nib = nifti.nibabel()
    if array.dtype not in (np.float32, np.float64):
        array = array.astype(np.uint8 if array.dtype == bool else np.float64)
    image = nib.Nifti1Image(array, volume.volume_affine)
    image.header.set_xyzt_units("mm")
    if symmetric:
        image.header.set_intent(nifti.SYMMETRIC_MATRIX, (3,))
    else:
        image.header["intent_name"] = name[:15].encode()
    with atomic_path(path) as temporary:
        nib.save(image, temporary)
    return Path(path)


def _write_npz(path: str | os.PathLike[str], arrays: dict[str, Any], volume: TensorVolume) -> Path:
    if not os.fspath(path).endswith(".npz"):
        raise ValueError(f"path: got {os.fspath(path)!r}; expected a name that ends in .npz, .nii or .nii.gz")
    place: dict[str, Any] = {"spacing": volume.spacing, "origin": volume.origin}
    if volume.mask is not None:
        place["mask"] = volume.mask
    if volume.affine is not None:
        place["affine"] = volume.affine
    with atomic_path(path) as temporary, open(temporary, "wb") as stream:
        np.savez_compressed(stream, **place, **arrays)
    return Path(path)
