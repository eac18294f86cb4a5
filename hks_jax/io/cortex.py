"""Read surfaces and maps in GIFTI and FreeSurfer's formats, and write maps, through the optional library nibabel.

A FreeSurfer vertex with the surface coordinates v has the scanner coordinates c + ASᵀv, where c is the centre of an
image volume, and the columns of A and S are the volume's axes in scanner coordinates and in surface coordinates
([systems](https://surfer.nmr.mgh.harvard.edu/fswiki/CoordinateSystems)).
"""

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from hks_jax.io.mesh_formats import Loaded
from hks_jax.optional import optional
from hks_jax.storage import UnsuitedError, atomic_path, content_of, reading

MAPS = ".func.gii"
"""The suffix of maps in GIFTI; Workbench knows the kind of the content by it."""
TRIANGLES = b"\xff\xff\xfe"
"""The first bytes of FreeSurfer's files of triangles."""
_VALUES = b"\xff\xff\xff"
"""The first bytes of FreeSurfer's files of one number for each vertex: lh.thickness, lh.curv, lh.sulc and others."""
STRUCTURE = "AnatomicalStructurePrimary"
"""The entry of GIFTI's metadata that names the structure of a surface, such as CortexLeft. Workbench asks for it."""
_GEOMETRY = ("NIFTI_INTENT_POINTSET", "NIFTI_INTENT_TRIANGLE")
_AXES = 6
"""The largest number of axes that GIFTI allows for an array."""


_OWN_AXES = np.array([[-1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""The matrix S, whose columns are the axes of a FreeSurfer volume in surface coordinates."""
_SCANNER = (1, 2)
"""NIfTI's codes for the scanner's coordinates, and for the coordinates of a volume aligned with the scanner."""


def load_freesurfer(path: Path, in_space: bool = False) -> Loaded:
    """Load a FreeSurfer surface with the coordinates in the file or, if `in_space`, with scanner coordinates, in mm."""
    library, content = optional("nibabel"), path.read_bytes()
    # The numbers of vertices and triangles follow two lines that contain a magic number and a comment.
    start = content.index(b"\n", content.index(b"\n", len(TRIANGLES)) + 1) + 1
    n_vertices, n_faces = np.frombuffer(content[start : start + 8], ">i4").tolist()
    end = start + 8 + 12 * (n_vertices + n_faces)
    if min(n_vertices, n_faces) < 0 or end > len(content):
        raise ValueError(
            f"got {len(content)} bytes; expected {end} for the declared {n_vertices} vertices, {n_faces} triangles"
        )
    vertices, faces = library.freesurfer.read_geometry(path)
    vertices = np.asarray(vertices, np.float64)
    if in_space and content[end : end + 8] != b"\0\0\0\2\0\0\0\1":  # this tag marks scanner coordinates
        told = {
            name: np.array(numbers.split(), np.float64)
            for name, numbers in re.findall(rb"([xyzc]ras)\s*=([-+.\deE \t]+)", content[end:])
        }
        axes = [told.get(name + b"ras", np.zeros(0)) for name in (b"x", b"y", b"z", b"c")]
        vertices = _from_own_axes(vertices, axes)
    side = {"lh.": "CortexLeft", "rh.": "CortexRight"}.get(path.name[:3], "")
    return Loaded(vertices, np.asarray(faces, np.int64), structure=side)


def _from_own_axes(vertices: np.ndarray, axes: list[np.ndarray]) -> np.ndarray:
    """Transform FreeSurfer's surface coordinates to scanner coordinates; `axes` has the volume's axes and centre."""
    if any(axis.shape != (3,) or not np.isfinite(axis).all() for axis in axes):
        raise UnsuitedError(
            "the file does not state the position of its volume (x_ras … c_ras), which scanner coordinates "
            "need. Convert the file by mris_convert --to-scanner"
        )
    return vertices @ (np.stack(axes[:3], axis=1) @ _OWN_AXES.T).T + axes[3]


def load_gifti(path: Path, in_space: bool = False) -> Loaded:
    """Load a GIFTI surface with the coordinates in the file or, if `in_space`, with scanner coordinates."""
    library, content = optional("nibabel"), content_of(path)
    # nibabel would loop over any declared number of axes, such as a billion.
    axes = [int(n) for n in re.findall(rb"Dimensionality\s*=\s*[\"'](\d+)", content)]
    if max(axes, default=0) > _AXES:
        raise ValueError(f"got an array of {max(axes)} axes; expected at most {_AXES}")
    image = library.gifti.GiftiImage.from_bytes(content)
    arrays_of_kinds = [image.get_arrays_from_intent(f"NIFTI_INTENT_{kind}") for kind in ("POINTSET", "TRIANGLE")]
    if not all(arrays_of_kinds):
        numbers = " and ".join(str(len(arrays)) for arrays in arrays_of_kinds)
        raise ValueError(f"got {numbers} arrays of points and of triangles; expected one of each")
    for kind, arrays in zip(("sets of points", "sets of triangles"), arrays_of_kinds, strict=True):
        if len(arrays) > 1:
            named = ", ".join(_name(array) or f"number {i} without a name" for i, array in enumerate(arrays, 1))
            raise UnsuitedError(
                f"got {len(arrays)} {kind} ({named}); expected one. Write each surface to a file of its own"
            )
    vertices, faces = (np.asarray(arrays[0].data) for arrays in arrays_of_kinds)
    if vertices.ndim != 2 or faces.ndim != 2 or faces.dtype.kind not in "iu":
        raise ValueError(f"got shapes {vertices.shape}, {faces.shape} ({faces.dtype}); expected (V, 3), (n, 3)")
    points, vertices = arrays_of_kinds[0][0], vertices.astype(np.float64)
    if in_space:
        vertices = _in_space(vertices, points)
    named = next((meta[STRUCTURE] for meta in (image.meta, points.meta) if meta.get(STRUCTURE)), "")
    return Loaded(vertices, faces.astype(np.int64), structure=str(named))


def _name(array: Any) -> str:
    """Return the metadata of a GIFTI array that describe its surface."""
    told = dict(array.meta)
    keys = ("Name", "AnatomicalStructurePrimary", "AnatomicalStructureSecondary", "GeometricType")
    return " ".join(str(told[key]) for key in keys if told.get(key))


# Workbench declares the coordinates of every file as coordinates of an atlas. Coordinates in an atlas or in an unknown
# space stay unchanged, unless FreeSurfer wrote the file in its surface coordinates.
def _in_space(vertices: np.ndarray, points: Any) -> np.ndarray:
    """Return scanner coordinates, by the transformation in the file or by the position of FreeSurfer's volume."""
    system, told = points.coordsys, dict(points.meta)
    if system is not None and system.dataspace in _SCANNER:
        return vertices
    if system is not None and system.xformspace in _SCANNER and system.xform is not None:
        affine = np.asarray(system.xform, np.float64)
        return vertices @ affine[:3, :3].T + affine[:3, 3]
    if "VolGeomC_R" not in told:
        return vertices
    axes = [np.array([float(told.get(f"VolGeom{a}_{b}", "nan")) for b in "RAS"]) for a in "XYZC"]
    return _from_own_axes(vertices, axes)


def load_maps(path: Path) -> list[Float[np.ndarray, "..."]] | None:
    """Load the maps at vertices in a GIFTI file, or FreeSurfer's one map; None if the file is neither."""
    if path.name.lower().endswith((".gii", ".gii.gz")):
        library = optional("nibabel")
        names = library.nifti1.intent_codes.niistring
        with reading(path, "a readable GIFTI file"):
            arrays = library.load(path).darrays
            return [np.asarray(array.data) for array in arrays if names[array.intent] not in _GEOMETRY]
    with open(path, "rb") as stream:
        is_freesurfer = stream.read(len(_VALUES)) == _VALUES
    if is_freesurfer:
        library = optional("nibabel")
        with reading(path, "a readable FreeSurfer map"):
            return [np.asarray(library.freesurfer.read_morph_data(path))]
    return None


def write_maps(path: Path, arrays: Mapping[str, Float[np.ndarray, " V"]], record: str) -> None:
    """Write named maps at the vertices of a surface in GIFTI, and a record of their origin in its metadata.

    The record's entry AnatomicalStructurePrimary, if any, becomes that of the file.
    """
    gifti = optional("nibabel").gifti

    def array_of(name: str, values: np.ndarray) -> Any:
        meta = gifti.GiftiMetaData(Name=name)
        kind = ("NIFTI_INTENT_NONE", "NIFTI_TYPE_FLOAT32")
        return gifti.GiftiDataArray(np.asarray(values, np.float32), *kind, meta=meta)

    arrays_of_image = [array_of(name, values) for name, values in arrays.items()]
    structure = {name: value for name, value in json.loads(record).items() if name == STRUCTURE}
    meta = gifti.GiftiMetaData({"provenance": record, **structure})
    image = gifti.GiftiImage(darrays=arrays_of_image, meta=meta)
    with atomic_path(path) as temporary:
        temporary.write_bytes(image.to_bytes())
