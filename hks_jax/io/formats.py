"""The file formats of images on grids, which a file's name chooses."""

import os

from hks_jax.io import arrays, mrtrix, nifti, nrrd, vtk_image
from hks_jax.io.volume import Format

FORMATS = (nifti.FORMAT, mrtrix.FORMAT, nrrd.FORMAT, vtk_image.FORMAT, arrays.FORMAT)

SUFFIXES: tuple[str, ...] = sum((each.names for each in FORMATS), ())
"""What tensors are read from."""
WRITTEN: tuple[str, ...] = sum((each.written for each in FORMATS), ())
"""What tensors and results on a grid are written as."""
IMAGES: tuple[str, ...] = sum((each.names for each in FORMATS if each.read_image), ())
"""What masks are read from."""


def format_of(path: str | os.PathLike[str], suffixes: tuple[str, ...] = SUFFIXES) -> Format:
    """Return the format of files of this name."""
    name = os.fspath(path)
    if not name.lower().endswith(suffixes):
        stem, _, suffix = name.rpartition(".")
        advice = ""
        if suffix.lower() == "mih":
            advice = f". MRtrix makes one file of it: mrconvert {name} {stem}.mif"
        elif suffix.lower() in ("bdouble", "bfloat"):
            advice = (
                f". Camino's own files do not say how many voxels there are along which axis: dt2nii -inputfile {name} "
                "-header IMAGE.nii.gz -outputroot OUT_ makes NIfTI of them, OUT_dt.nii.gz"
            )
        raise ValueError(f"{name}: unknown kind of file; expected {', '.join(suffixes)}{advice}")
    return next(each for each in FORMATS if name.lower().endswith(each.names))
