"""Read tensors from six images of one component each, as BIDS (``param-txx``), DSI Studio and ANTs name them."""

import math
import os
import re
from collections.abc import Sequence

import numpy as np

from hks_jax.io import nifti
from hks_jax.io.tensor_order import ORDERS
from hks_jax.io.volume import TensorVolume
from hks_jax.optional import optional

NAMES = ORDERS["nifti"]
_NAME = re.compile(r"(?:^|[_.-])(?:dt|t|d)?(xx|xy|xz|yy|yz|zz)(?=[_.])", re.IGNORECASE)


def component_of(path: str | os.PathLike[str]) -> str | None:
    """Return the component that a file's name states, such as ``"xy"`` for ``dtxy.nii``, or None."""
    names = _NAME.findall(os.path.basename(path))
    return names[-1].lower() if names else None


def siblings(path: str | os.PathLike[str]) -> list[str]:
    """Return the paths of all six components, whose names differ only in the component, from one of these paths."""
    folder, name = os.path.split(os.fspath(path))
    matches = list(_NAME.finditer(name))
    if not matches:
        raise ValueError(f"{os.fspath(path)}: the file's name states no component; expected one such as txx or Dxx")
    start, end = matches[-1].span(1)
    upper = name[start:end].isupper()
    names = [os.path.join(folder, name[:start] + (c.upper() if upper else c) + name[end:]) for c in NAMES]
    missing = [os.path.basename(each) for each in names if not os.path.isfile(each)]
    if missing:
        raise FileNotFoundError(
            f"{os.fspath(path)}: the name states one of six components, but these files are missing: "
            f"{', '.join(missing)}. Put all six into one folder"
        )
    return names


def is_one_of_six(path: str | os.PathLike[str]) -> bool:
    """Return whether a NIfTI file's name states a component and the image has one value per voxel."""
    return component_of(path) is not None and math.prod(nifti.load(os.fspath(path)).shape[3:]) == 1


def read_tensors(paths: Sequence[str | os.PathLike[str]], order: str | None, frame: str | None) -> TensorVolume:
    """Read tensors from six NIfTI images in any sequence; each file's name states its component.

    If `frame` is None, the BIDS sidecar of the image gives the axes of the components (``Reference`` in
    ``OrientationEncoding``). Without a sidecar, they are the voxel axes.
    """
    if order is not None:
        raise ValueError(f"order: got {order!r}, but the names of six images state their components. Leave it out")
    files = {component_of(path): os.fspath(path) for path in paths}
    if len(paths) != 6 or set(files) != set(NAMES):
        given = ", ".join(f"{os.path.basename(path)} ({component_of(path) or 'none'})" for path in paths)
        raise ValueError(
            f"files: got {given}; expected six NIfTI images, one for each component {' '.join(NAMES)}. Name the files "
            "by their components, as in sub-01_param-txx_dwimap.nii.gz or dtxx.nii.gz"
        )
    images = [nifti.load(files[name]) for name in NAMES if nifti.is_nifti(files[name])]
    if len(images) < 6:
        raise ValueError(f"files: got {', '.join(files.values())}; expected NIfTI images, .nii or .nii.gz")
    first = images[0]
    affine = nifti.affine_in_mm(files["xx"], first)[0]
    for name, image in zip(NAMES, images, strict=True):
        if image.shape != first.shape or math.prod(image.shape[3:]) != 1:
            raise ValueError(
                f"{files[name]}: got shape {image.shape}; expected one component per voxel, and equal shapes"
            )
        if not np.allclose(nifti.affine_in_mm(files[name], image)[0], affine, rtol=1e-4, atol=1e-3):
            raise ValueError(f"{files[name]}: its affine differs from the affine of {files['xx']}; expected equal ones")
    values = np.stack([nifti.voxels(files[name], image) for name, image in zip(NAMES, images, strict=True)], axis=-1)
    joined = optional("nibabel").Nifti1Image(values.reshape(*first.shape[:3], 1, 6), first.affine)
    joined.header["xyzt_units"] = first.header["xyzt_units"]
    joined.header.set_intent(nifti.SYMMETRIC_MATRIX, (3,))
    return nifti.tensors_of(files["xx"], joined, None, frame)
