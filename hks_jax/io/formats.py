"""The file formats of images on grids; the suffix of a file determines its format."""

import os

from hks_jax.io import arrays, mrtrix, nifti, nrrd, vtk_image
from hks_jax.io.volume import Format

FORMATS = (nifti.FORMAT, mrtrix.FORMAT, nrrd.FORMAT, vtk_image.FORMAT, arrays.FORMAT)

SUFFIXES: tuple[str, ...] = sum((each.names for each in FORMATS), ())
"""The suffixes of files from which tensors are read."""
WRITTEN: tuple[str, ...] = sum((each.written for each in FORMATS), ())
"""The suffixes of files to which tensors and results on a grid are written."""
IMAGES: tuple[str, ...] = sum((each.names for each in FORMATS if each.read_image), ())
"""The suffixes of files from which masks are read."""


def format_of(path: str | os.PathLike[str], suffixes: tuple[str, ...] = SUFFIXES) -> Format:
    """Return the format that belongs to the suffix of a path; raise ValueError if none of `suffixes` matches."""
    name = os.fspath(path)
    if not name.lower().endswith(suffixes):
        stem, _, suffix = name.rpartition(".")
        advice = ""
        if suffix.lower() == "mih":
            advice = f". MRtrix converts it into one file: mrconvert {name} {stem}.mif"
        elif suffix.lower() in ("bdouble", "bfloat"):
            advice = (
                f". Camino's raw files do not state the image's shape. Convert them to NIfTI (OUT_dt.nii.gz): dt2nii "
                f"-inputfile {name} -header IMAGE.nii.gz -outputroot OUT_"
            )
        raise ValueError(f"{name}: the kind of file is unknown; expected {', '.join(suffixes)}{advice}")
    return next(each for each in FORMATS if name.lower().endswith(each.names))
