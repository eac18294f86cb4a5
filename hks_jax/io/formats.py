"""The file formats of images on grids: a module for each, which a file's name chooses.

A module says what its files are called (``SUFFIXES``), which of these it writes (``WRITTEN``), the suffix of results
beside tensors in its format (``IMAGE``, empty where an npz is enough), and what `read_tensors` takes beside the order
and the frame (``OPTIONS``). It has `read_tensors` and, where its files hold such things, `read_image` for masks and
labels, `write` for results and `write_tensors`. A new format is a new module, and its name in `FORMATS`.
"""

import os
from types import ModuleType

from hks_jax.io import arrays, mrtrix, nifti, nrrd, vtk_image

FORMATS: tuple[ModuleType, ...] = (nifti, mrtrix, nrrd, vtk_image, arrays)

SUFFIXES: tuple[str, ...] = sum((each.SUFFIXES for each in FORMATS), ())
"""What tensors are read from."""
WRITTEN: tuple[str, ...] = sum((each.WRITTEN for each in FORMATS), ())
"""What tensors and results on a grid are written as."""
IMAGES: tuple[str, ...] = sum((each.SUFFIXES for each in FORMATS if hasattr(each, "read_image")), ())
"""What masks are read from."""


def format_of(path: str | os.PathLike[str], suffixes: tuple[str, ...] = SUFFIXES) -> ModuleType:
    """Return the module that reads and writes files of this name.

    Raises:
        ValueError: a name that ends in none of the suffixes.
    """
    name = os.fspath(path)
    if not name.lower().endswith(suffixes):
        stem, _, suffix = name.rpartition(".")
        advice = f". MRtrix makes one file of it: mrconvert {name} {stem}.mif" if suffix.lower() == "mih" else ""
        raise ValueError(f"{name}: unknown kind of file; expected {', '.join(suffixes)}{advice}")
    return next(each for each in FORMATS if name.lower().endswith(each.SUFFIXES))
