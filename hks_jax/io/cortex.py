"""Surfaces in the formats of neuroimaging, GIFTI and FreeSurfer's, through nibabel, which is optional."""

import gzip
import re
from pathlib import Path

import numpy as np

from hks_jax.io.mesh_formats import Loaded
from hks_jax.io.nifti import nibabel
from hks_jax.reading import reading

_TRIANGLES = b"\xff\xff\xfe"
"""What FreeSurfer's files of triangles begin with."""
_AXES = 6
"""GIFTI's arrays have no more."""


def is_freesurfer(path: Path) -> bool:
    """Tell by its first bytes whether a file is a surface of FreeSurfer's."""
    if not path.is_file():
        return False
    with open(path, "rb") as stream:
        return stream.read(len(_TRIANGLES)) == _TRIANGLES


def load_freesurfer(path: Path) -> Loaded:
    """Load a surface of FreeSurfer's: coordinates in mm as they are in the file, not moved by its volume's centre."""
    library = nibabel()
    with reading(path, "a readable surface of FreeSurfer's"):
        content = path.read_bytes()
        # The magic number and a remark end with the second line; then the numbers of vertices and triangles.
        start = content.index(b"\n", content.index(b"\n", len(_TRIANGLES)) + 1) + 1
        n_vertices, n_faces = np.frombuffer(content[start : start + 8], ">i4").tolist()
        end = start + 8 + 12 * (n_vertices + n_faces)
        if min(n_vertices, n_faces) < 0 or end > len(content):
            raise ValueError(
                f"it declares {n_vertices} vertices and {n_faces} triangles, which end at byte {end}, and has "
                f"{len(content)} bytes"
            )
        vertices, faces = library.freesurfer.read_geometry(path)
    return Loaded(np.asarray(vertices, np.float64), np.asarray(faces, np.int64), {})


def load_gifti(path: Path) -> Loaded:
    """Load a surface from GIFTI: coordinates as they are in the file, whatever transformation it also holds."""
    library = nibabel()
    with reading(path, "a readable GIFTI surface"):
        content = gzip.decompress(path.read_bytes()) if path.suffix.lower() == ".gz" else path.read_bytes()
        # nibabel counts up to them.
        axes = [int(n) for n in re.findall(rb"Dimensionality\s*=\s*[\"'](\d+)", content)]
        if max(axes, default=0) > _AXES:
            raise ValueError(f"an array of {max(axes)} axes")
        image = library.gifti.GiftiImage.from_bytes(content)
        arrays_of_kinds = [image.get_arrays_from_intent(f"NIFTI_INTENT_{kind}") for kind in ("POINTSET", "TRIANGLE")]
        if [len(arrays) for arrays in arrays_of_kinds] != [1, 1]:
            numbers = " and ".join(str(len(arrays)) for arrays in arrays_of_kinds)
            raise ValueError(f"it has {numbers} arrays of points and of triangles; expected one of each")
        vertices, faces = (np.asarray(arrays[0].data) for arrays in arrays_of_kinds)
        if vertices.ndim != 2 or faces.ndim != 2 or faces.dtype.kind not in "iu":
            raise ValueError(f"points of shape {vertices.shape}, triangles of shape {faces.shape} and {faces.dtype}")
    return Loaded(vertices.astype(np.float64), faces.astype(np.int64), {})
