"""Masks: which voxels belong to the domain."""

import os
from typing import Any

import numpy as np
from jaxtyping import Bool
from scipy import ndimage

from hks_jax.checks import require_real
from hks_jax.io import mrtrix, nifti, nrrd
from hks_jax.npz import load_npy, load_npz


def read_mask(path: str | os.PathLike[str], affine: np.ndarray | None = None) -> Bool[np.ndarray, "*shape"]:
    """Read a mask of zeros and ones: NIfTI, MRtrix, NRRD, ``.npy``, or the array ``mask`` of an ``.npz``.

    Args:
        path: the file.
        affine: where the image lies that the mask is for; a mask that lies elsewhere is refused.

    Raises:
        FileNotFoundError: no such file.
        ValueError: an unknown kind of file, values other than 0 and 1, or a mask that lies elsewhere.
        ImportError: NIfTI without nibabel, NRRD without pynrrd.
    """
    name = os.fspath(path)
    if nifti.is_nifti(path):
        image = nifti.load(path)
        values = nifti.voxels(path, image)
        while values.ndim > 3 and values.shape[-1] == 1:
            values = values[..., 0]
        if affine is not None:
            _check_same_place(name, nifti.affine_beside(name, image, affine), affine, values.shape)
    elif mrtrix.is_mrtrix(path):
        mask = mrtrix.load(path)
        values = mask.values[..., 0] if mask.values.ndim == 4 and mask.values.shape[-1] == 1 else mask.values
        if affine is not None:
            _check_same_place(name, mask.affine, affine, values.shape)
    elif name.endswith(".npz"):
        arrays = load_npz(path)
        if "mask" not in arrays:
            raise ValueError(f"{name}: has no array 'mask' (it has {', '.join(sorted(arrays)) or 'none'})")
        values = arrays["mask"]
    elif nrrd.is_nrrd(path):
        values, place = nrrd.read_image(path, affine)
        if affine is not None and place is not None:
            _check_same_place(name, place, affine, values.shape)
    elif name.endswith(".npy"):
        values = load_npy(path)
    else:
        expected = ".nii, .nii.gz, .mif, .mif.gz, .nrrd, .nhdr, .npz or .npy"
        raise ValueError(f"{name}: unknown kind of file; expected {expected}{of_mrtrix(name)}")
    return as_mask(name, values)


def of_mrtrix(name: str) -> str:
    """Return the advice for images of MRtrix in two files, which are not read; the empty text for others."""
    stem, _, suffix = name.rpartition(".")
    return "" if suffix.lower() != "mih" else f". MRtrix makes one file of it: mrconvert {name} {stem}.mif"


def as_mask(name: str, values: Any) -> Bool[np.ndarray, "*shape"]:
    """Return zeros and ones as booleans; raise ValueError for anything else."""
    array = np.asarray(values)
    require_real(name, array)
    if array.dtype != bool and not np.isin(array, (0, 1)).all():
        raise ValueError(f"{name}: got mask values other than 0 and 1; threshold it first, for example mask > 0.5")
    return array.astype(bool)


def erode(mask: Bool[np.ndarray, "*shape"], iterations: int = 1) -> Bool[np.ndarray, "*shape"]:
    """Peel voxels off the rim of a mask, where voxels mix tissues and tensors are least reliable.

    A voxel goes when a face neighbour is outside, once per iteration. The image's own border is no rim: a volume
    that ends inside the head keeps its last slices.

    Raises:
        ValueError: a negative number of iterations, or nothing left.
    """
    if iterations < 0:
        raise ValueError(f"iterations: got {iterations}; expected 0 or more")
    if iterations == 0:
        return mask
    eroded = ndimage.binary_erosion(mask, iterations=iterations, border_value=1)
    if not eroded.any():
        raise ValueError(f"iterations: eroding by {iterations} voxels leaves nothing of {int(mask.sum())} voxels")
    return eroded


def _check_same_place(name: str, mask_affine: np.ndarray, affine: np.ndarray, shape: tuple[int, ...]) -> None:
    """Raise ValueError if any corner of the mask lies over half a voxel from the same corner of the image."""
    corners = np.stack(np.meshgrid(*[(0, n - 1) for n in shape[:3]], [1], indexing="ij"), -1).reshape(-1, 4)
    shift = np.linalg.norm(corners @ (mask_affine - affine).T, axis=1).max()
    if shift > 0.5 * np.linalg.norm(affine[:3, :3], axis=0).min():
        raise ValueError(
            f"{name}: the mask's affine places it up to {shift:.3g} away from the tensors'; expected the same place. "
            "Resample the mask to the tensors' voxels"
        )
