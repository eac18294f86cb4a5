"""NIfTI through nibabel, which is optional."""

import os
import zlib
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

SUFFIXES = (".nii", ".nii.gz")
SYMMETRIC_MATRIX = 1005
"""NIfTI's intent code for symmetric matrices."""


def is_nifti(path: str | os.PathLike[str]) -> bool:
    """Tell by the name whether a file is NIfTI."""
    return os.fspath(path).lower().endswith(SUFFIXES)


def nibabel() -> ModuleType:
    """Import nibabel.

    Raises:
        ImportError: it is not installed; says how to get it.
    """
    try:
        import nibabel
    except ImportError as error:
        raise ImportError(
            'reading and writing NIfTI needs nibabel, which is not installed: pip install "hks-jax[dti]"'
        ) from error
    return nibabel


def load(path: str | os.PathLike[str]) -> Any:
    """Open a NIfTI image.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not a NIfTI image.
    """
    nib = nibabel()
    existing(path)
    try:
        return nib.load(path)
    except (nib.filebasedimages.ImageFileError, OSError, EOFError, zlib.error) as error:
        raise ValueError(f"{os.fspath(path)}: not a readable NIfTI image ({error})") from error


def voxels(image: Any) -> np.ndarray:
    """Return the voxel values of an image, scaled, floating point as stored or float64.

    Raises:
        ValueError: a damaged file.
    """
    try:
        data = np.asarray(image.dataobj)
    except (OSError, EOFError, ValueError, zlib.error) as error:
        raise ValueError(f"{image.get_filename()}: the voxel data are damaged or incomplete ({error})") from error
    dtype = data.dtype if data.dtype.kind == "f" and data.dtype.itemsize in (4, 8) else np.dtype(np.float64)
    return np.ascontiguousarray(data, dtype=dtype.newbyteorder("="))


def existing(path: str | os.PathLike[str]) -> Path:
    """Return the path of a file that exists.

    Raises:
        FileNotFoundError: it does not, or is a folder.
    """
    file = Path(path)
    if not file.is_file():
        what = "is a folder; expected a file" if file.is_dir() else "no such file"
        raise FileNotFoundError(f"{file}: {what}")
    return file
