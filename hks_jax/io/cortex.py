"""Surfaces in the formats of neuroimaging, GIFTI and FreeSurfer's, through nibabel, which is optional.

Their vertices may have coordinates of their own, with a transformation to those of the scanner beside them.
FreeSurfer's begin at the middle of a volume, whose axes x̂, ŷ, ẑ and centre c the file tells; in them the axes are −e₁,
−e₃ and e₂ ([coordinates](https://surfer.nmr.mgh.harvard.edu/fswiki/CoordinateSystems)). So v lies at c + [x̂ ŷ ẑ] Sᵀv.
"""

import gzip
import re
from pathlib import Path
from typing import Any

import numpy as np

from hks_jax.io.mesh_formats import Loaded
from hks_jax.optional import optional
from hks_jax.storage import reading

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


_OWN_AXES = np.array([[-1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""S: the axes of FreeSurfer's volumes, as columns, in the coordinates of its surfaces."""
_SCANNER = (1, 2)
"""NIfTI's codes of the scanner's coordinates, and of those of a volume that was aligned with it."""


def load_freesurfer(path: Path, in_space: bool = False) -> Loaded:
    """Load a surface of FreeSurfer's: coordinates in mm as they are in the file, or those of the scanner."""
    library = optional("nibabel")
    with reading(path, "a readable surface of FreeSurfer's"):
        content = path.read_bytes()
        # The magic number and a remark end with the second line; then the numbers of vertices and triangles.
        start = content.index(b"\n", content.index(b"\n", len(_TRIANGLES)) + 1) + 1
        n_vertices, n_faces = np.frombuffer(content[start : start + 8], ">i4").tolist()
        end = start + 8 + 12 * (n_vertices + n_faces)
        if min(n_vertices, n_faces) < 0 or end > len(content):
            raise ValueError(
                f"it declares {n_vertices} vertices and {n_faces} triangles, {end} bytes, and has {len(content)} bytes"
            )
        vertices, faces = library.freesurfer.read_geometry(path)
    vertices = np.asarray(vertices, np.float64)
    if in_space and content[end : end + 8] != b"\0\0\0\2\0\0\0\1":  # which says that they are the scanner's
        told = {
            name: np.array(numbers.split(), np.float64)
            for name, numbers in re.findall(rb"([xyzc]ras)\s*=([-+.\deE \t]+)", content[end:])
        }
        vertices = _from_own_axes(path, vertices, [told.get(name + b"ras") for name in (b"x", b"y", b"z", b"c")])
    return Loaded(vertices, np.asarray(faces, np.int64), {})


def _from_own_axes(path: Path, vertices: np.ndarray, axes: list[np.ndarray | None]) -> np.ndarray:
    """Return coordinates of the scanner, of FreeSurfer's own and its volume's axes x̂, ŷ, ẑ and centre."""
    known = [axis for axis in axes if axis is not None and axis.shape == (3,)]
    if len(known) < 4:
        raise ValueError(
            f"{path}: it does not say where its volume lies (x_ras … c_ras), so that its vertices have no place in "
            "space; write it anew by mris_convert --to-scanner"
        )
    return vertices @ (np.stack(known[:3], axis=1) @ _OWN_AXES.T).T + known[3]


def load_gifti(path: Path, in_space: bool = False) -> Loaded:
    """Load a surface from GIFTI: coordinates as they are in the file, or those of the scanner."""
    library = optional("nibabel")
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
    vertices = vertices.astype(np.float64)
    if in_space:
        vertices = _in_space(path, vertices, arrays_of_kinds[0][0])
    return Loaded(vertices, faces.astype(np.int64), {})


# A file whose coordinates are said to be an atlas's, as Workbench writes of all, or of nothing known, has them as they
# are; unless it was FreeSurfer who wrote it, and its own coordinates.
def _in_space(path: Path, vertices: np.ndarray, points: Any) -> np.ndarray:
    """Return coordinates of the scanner, by the transformation to them or what FreeSurfer says of its volume."""
    system, told = points.coordsys, dict(points.meta)
    if system is not None and system.dataspace in _SCANNER:
        return vertices
    if system is not None and system.xformspace in _SCANNER and system.xform is not None:
        affine = np.asarray(system.xform, np.float64)
        return vertices @ affine[:3, :3].T + affine[:3, 3]
    if "VolGeomC_R" not in told:
        return vertices
    axes = [np.array([float(told.get(f"VolGeom{a}_{b}", "nan")) for b in "RAS"]) for a in "XYZC"]
    return _from_own_axes(path, vertices, [axis if np.isfinite(axis).all() else None for axis in axes])
