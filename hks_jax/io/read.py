"""Reading tensor volumes."""

import os
from typing import Any

import numpy as np
from jaxtyping import Bool

from hks_jax.io import nifti
from hks_jax.io.masks import as_mask, read_mask
from hks_jax.io.npz import load_npz
from hks_jax.io.tensor_order import FRAMES, Frame, Order, choices, to_voxel_axes, unpack
from hks_jax.io.volume import TensorVolume


def read_tensors(
    path: str | os.PathLike[str],
    order: Order | None = None,
    mask: str | os.PathLike[str] | Bool[np.ndarray, "*shape"] | None = None,
    *,
    frame: Frame | None = None,
) -> TensorVolume:
    """Read a field of diffusion tensors.

    NIfTI (``.nii``, ``.nii.gz``): a symmetric-matrix image, (nx, ny, nz, 1, 6) with intent code 1005, whose components
    are xx xy yy xz yz zz; or any (nx, ny, nz, 6) or (nx, ny, nz, 1, 6) image whose `order` is given, because
    programs differ. The distance between voxels is that of the affine.

    npz: the array ``tensors`` (nx, ny, 2, 2) or (nx, ny, nz, 3, 3), array axis a being coordinate a and tensor index a;
    and, optional, ``spacing`` (d,) = 1, ``origin`` (d,) = 0, ``mask`` (*shape,), ``affine`` (4, 4).

    Args:
        path: the file.
        order: ``"nifti"`` (xx xy yy xz yz zz), ``"fsl"`` (xx xy xz yy yz zz) or ``"mrtrix"`` (xx yy zz xy xz yz);
            None: as the file declares. Only for six components.
        mask: a file (see `read_mask`) or a bool array of the volume's shape; None: the npz's own, or no mask.
        frame: the axes along which the file's components are: ``"voxel"``; ``"fsl"`` (voxel axes, the first reversed
            where the affine's determinant is positive); ``"world"`` (the scanner axes of the affine). None: what
            the order's programs write: voxel axes for ``"nifti"``, ``"fsl"``, and ``"world"`` for ``"mrtrix"``.

    Returns:
        The tensors along the voxel axes.

    Raises:
        FileNotFoundError: no such file.
        ValueError: an unreadable or unknown kind of file; six components of undeclared order; shapes that disagree.
        ImportError: NIfTI without nibabel.
    """
    name = os.fspath(path)
    if nifti.is_nifti(path):
        volume = _from_nifti(name, order, frame)
    elif name.lower().endswith(".npz"):
        if order is not None or frame is not None:
            raise ValueError("order, frame: an npz holds whole matrices along the grid's axes; leave these out")
        volume = _from_npz(name)
    else:
        raise ValueError(f"{name}: unknown kind of file; expected .nii, .nii.gz or .npz")
    if mask is None:
        return volume
    inside = as_mask("mask", mask) if isinstance(mask, np.ndarray) else read_mask(mask, volume.affine)
    if inside.shape != volume.shape:
        raise ValueError(f"mask: got shape {inside.shape}; expected the tensors' shape {volume.shape}")
    return volume.with_mask(inside)


def _from_nifti(name: str, order: str | None, frame: str | None) -> TensorVolume:
    image = nifti.load(name)
    shape = image.shape
    if shape[3:] not in ((6,), (1, 6)):
        raise ValueError(
            f"{name}: got an image of shape {shape}; expected six components per voxel, (nx, ny, nz, 1, 6) or "
            "(nx, ny, nz, 6). Fit tensors to diffusion-weighted images first: hks_jax.io.fit_dwi"
        )
    declared = int(image.header["intent_code"]) == nifti.SYMMETRIC_MATRIX
    if order is None and not declared:
        raise ValueError(
            f"{name}: six components, but the file does not declare their order (its NIfTI intent is not "
            f"symmetric-matrix), and programs differ. Pass order: one of {choices()}"
        )
    notes = []
    if order is None:
        order = "nifti"
    elif declared and order != "nifti":
        notes.append(f'read in order "{order}" as asked, though the file declares NIfTI\'s symmetric-matrix order')
    tensors = unpack(nifti.voxels(image).reshape(*shape[:3], 6), order)
    frame = FRAMES[order] if frame is None else frame
    affine = np.asarray(image.affine, np.float64)
    spacing = np.linalg.norm(affine[:3, :3], axis=0)
    if not (np.isfinite(affine).all() and spacing.min() > 0):
        raise ValueError(f"{name}: the affine is singular or not finite; expected one that places the voxels in space")
    axes = affine[:3, :3] / spacing
    if np.abs(axes.T @ axes - np.eye(3)).max() > 1e-3:
        notes.append("the affine's axes are not orthogonal: the shear is ignored")
    header = np.asarray(image.header.get_zooms()[:3], np.float64)
    if np.abs(header / spacing - 1).max() > 1e-3:
        notes.append(f"voxel sizes {_sizes(spacing)} are those of the affine; the header's own are {_sizes(header)}")
    notes.append(f'tensors in order "{order}", given along the {frame} axes, taken to the voxel axes')
    return TensorVolume(
        to_voxel_axes(tensors, frame, affine),
        tuple(spacing.tolist()),
        (0.0, 0.0, 0.0),
        affine=affine,
        order=order,
        notes=tuple(notes),
        source=name,
    )


def _from_npz(name: str) -> TensorVolume:
    arrays = load_npz(name)
    if "tensors" not in arrays:
        raise ValueError(
            f"{name}: has no array 'tensors' (it has {', '.join(sorted(arrays)) or 'none'}); expected 'tensors' of "
            "shape (*shape, d, d) and, optional, 'spacing', 'origin', 'mask', 'affine'"
        )
    tensors = arrays["tensors"]
    if tensors.dtype not in (np.float32, np.float64):
        if tensors.dtype.kind not in "fiu":
            raise ValueError(f"{name}: 'tensors' has dtype {tensors.dtype}; expected real numbers")
        tensors = tensors.astype(np.float64)
    d = tensors.shape[-1] if tensors.ndim else 0
    affine, mask = arrays.get("affine"), arrays.get("mask")
    return TensorVolume(
        tensors,
        _per_axis(arrays.get("spacing", 1.0), d),
        _per_axis(arrays.get("origin", 0.0), d),
        None if mask is None else as_mask(f"{name}: mask", mask),
        None if affine is None else np.asarray(affine, np.float64),
        source=name,
    )


def _per_axis(value: Any, d: int) -> tuple[float, ...]:
    array = np.asarray(value, np.float64)
    return tuple((np.full(d, array) if array.ndim == 0 else array.ravel()).tolist())


def _sizes(values: np.ndarray) -> str:
    return " × ".join(f"{v:.5g}" for v in values)
