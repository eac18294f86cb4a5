"""Read and write tensors (of all kinds that NRRD defines), masks and results through the optional library pynrrd.

pynrrd reads the header and the data. It accepts any name of a field, so that a damaged name would give a default, such
as a spacing of 1: names and lengths of fields are checked here.
"""

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from hks_jax.accuracy import warn_of_accuracy
from hks_jax.io.repair import require_symmetric
from hks_jax.io.tensor_order import matrices, nearest_rotation, pack, shear_notes, to_voxel_axes
from hks_jax.io.units import millimetres
from hks_jax.io.volume import Format, TensorVolume, describe_tensors, images_of, own_record
from hks_jax.naming import argument
from hks_jax.optional import optional
from hks_jax.storage import atomic_path, reading

KINDS = {
    f"{d}D-{masked}{symmetric}matrix": (d * (d + 1) // 2 if symmetric else d * d) + bool(masked)
    for d in (2, 3)
    for masked in ("", "masked-")
    for symmetric in ("", "symmetric-")
}
"""The number of entries along an axis of tensor components, by kind of axis; masked kinds also have a confidence."""

_FIELDS = (
    "dimension, type, block size, blocksize, encoding, endian, content, min, max, old min, oldmin, old max, oldmax, "
    "data file, datafile, line skip, lineskip, byte skip, byteskip, number, sample units, sampleunits, sizes, "
    "spacings, thicknesses, axis mins, axismins, axis maxs, axismaxs, centers, centerings, labels, units, kinds, "
    "space, space dimension, space units, space origin, space directions, measurement frame"
)
"""All fields of the format (Teem, "Definition of NRRD File Format")."""

_PATIENT = {
    "right-anterior-superior": (1.0, 1.0, 1.0),
    "left-anterior-superior": (-1.0, 1.0, 1.0),
    "left-posterior-superior": (-1.0, -1.0, 1.0),
}
"""The patient-based spaces, and the signs that transform their coordinates to NIfTI's: right, anterior, superior."""

_SHORT = {"".join(word[0] for word in name.split("-")): name for name in _PATIENT}
_SPACES = (*_PATIENT, "scanner-xyz", "3d-right-handed", "3d-left-handed")

_PER_AXIS = ("sizes", "spacings", "thicknesses", "kinds", "units", "space directions")


class Placement(NamedTuple):
    """The position of the voxels, in mm if the file declares a unit.

    Attributes:
        directions: column a is the step along voxel axis a, in the file's space.
        origin: the position of voxel 0, in the file's space.
        signs: the signs that transform a patient-based space to right, anterior, superior; None for other spaces.
        measured: the vectors of the measurement frame as columns, or None.
        placed: whether the file gives the directions of the voxel axes, and not only the spacings.
        unit: the file's unit of length; empty if there is none.
    """

    directions: Float[np.ndarray, "d d"]
    origin: Float[np.ndarray, " d"]
    signs: Float[np.ndarray, " d"] | None
    measured: Float[np.ndarray, "m n"] | None
    placed: bool
    unit: str

    @property
    def affine(self) -> Float[np.ndarray, "4 4"] | None:
        """The map from voxel indices to world coordinates; None if spacing and origin describe it completely."""
        d = len(self.origin)
        diagonal = np.array_equal(self.directions, np.diag(np.abs(np.diag(self.directions))))
        if d != 3 or (self.signs is None and diagonal):
            return None
        affine = np.eye(4)
        signs = np.ones(3) if self.signs is None else self.signs
        affine[:3, :3], affine[:3, 3] = signs[:, None] * self.directions, signs * self.origin
        return affine


def load(name: str) -> tuple[np.ndarray, dict[str, Any]]:
    """Return the array in native byte order, with the fastest axis of the file first, and the header."""
    nrrd = optional("nrrd")
    with reading(name, "a readable NRRD file") as file, open(file, "rb") as stream, warnings.catch_warnings():
        warnings.filterwarnings("error", "string or file could not be read", DeprecationWarning)  # malformed text
        header = dict(nrrd.read_header(stream))
        start = stream.tell()
        stream.seek(0)
        _check_header(stream.read(start), header)
        stream.seek(start)
        data = nrrd.read_data(header, stream, str(file), index_order="F")
    return data.astype(data.dtype.newbyteorder("=")), header


def _check_header(text: bytes, header: Mapping[str, Any]) -> None:
    """Raise ValueError for a header line that is neither a field nor a key, and for a field of wrong length."""
    fields = _FIELDS.split(", ")
    for line in text.splitlines()[1:]:
        if line.startswith(b"#") or not line:
            continue
        key, colon, value = line.partition(b":")
        name, is_key = key.decode("latin-1"), value.startswith(b"=")
        if not colon or (name in fields) == is_key or (not is_key and not line.isascii()) or b"\0" in line:
            raise ValueError(f"got the header line {line[:60]!r}; expected a field of the format, or a key and a value")
    n = int(header["dimension"])
    for name in _PER_AXIS:
        if name in header and len(header[name]) != n:
            raise ValueError(f"{name}: got {len(header[name])} entries; expected {n}, one per axis")
    _space_of(header)


def _space_of(header: Mapping[str, Any]) -> str:
    """Return the full name of the space in lower case, without its time axis, or the empty text if there is none."""
    space = str(header.get("space", "")).lower()
    name = _SHORT.get(space.removesuffix("t"), space.removesuffix("-time"))
    if "space" in header and name not in _SPACES:
        raise ValueError(f"space: got {space!r}; expected a space of the format, such as left-posterior-superior")
    return name


def _read_image(name: str) -> tuple[np.ndarray, Float[np.ndarray, "4 4"] | None, str]:
    data, header = load(name)
    place = _placement(name, header, list(range(data.ndim)))
    return data, place.affine, place.unit


def _read_tensors(name: str, order: str | None, frame: str | None, confidence: float) -> TensorVolume:
    data, header = load(name)
    axis, label = _tensor_axis(name, data.shape, header)
    domain = [a for a in range(data.ndim) if a != axis]
    components = np.moveaxis(data, axis, -1)
    components = components.astype(np.result_type(components.dtype, np.float32), copy=False)
    notes, mask = [], None
    if label is not None and "masked" in label:
        mask, components = components[..., 0] > confidence, components[..., 1:]
        notes.append(f"the mask has the {int(mask.sum())} voxels where the file's confidence exceeds {confidence:g}")
    found = matrices(name, components, order, "" if label is None else "nrrd")
    if label is not None and order is not None:
        notes.append(f'components read in order "{order}", as asked; the file declares {label}')
    d = found.tensors.shape[-1]
    if len(domain) != d:
        raise ValueError(f"{name}: got {d}×{d} tensors on {len(domain)} axes of voxels; expected {d} axes")
    place = _placement(name, header, domain)
    spacing = np.linalg.norm(place.directions, axis=0)
    affine = place.affine
    notes += shear_notes(place.directions)
    tensors, frame = _to_voxel_axes(name, found.tensors, frame, place, notes)
    if affine is not None and place.signs is None:
        space = f"the axes of the file's space, {header.get('space', 'unnamed')!r}"
        notes.append(f"the affine's axes are {space}; pictures take them as right, anterior and superior")
    elif affine is None and d == 2 and not np.allclose(place.directions, np.diag(spacing)):
        notes.append("the coordinate axes are the axes of the 2D image; directions of its axes in the file are ignored")
    if place.unit not in ("", "mm"):
        notes.append(f"lengths converted from {place.unit}, which the file declares, to mm")
    notes.append(found._replace(of=f" ({label or 'as asked'})").note(frame))
    # Patient spaces are in mm, except in a file whose own record says that the unit is not known.
    record, length_unit = own_record(header.get("provenance", "")), "mm" * bool(place.unit or place.signs is not None)
    if place.unit in ("", "mm"):
        length_unit = record.get("length_unit", length_unit)
    return TensorVolume(
        np.ascontiguousarray(tensors),
        tuple(spacing.tolist()),
        tuple((place.origin if affine is None else np.zeros(d)).tolist()),
        mask,
        affine,
        order=found.order,
        frame=frame,
        notes=tuple(notes),
        source=name,
        invalid_by_order=found.invalid,
        length_unit=length_unit,
        unit=record.get("unit", ""),
    )


def _write(path: Path, array: np.ndarray, volume: TensorVolume, name: str, extra: dict[str, Any], record: str) -> None:
    if volume.affine is not None:
        array = images_of(array, volume)
    elif array.ndim > volume.dimension:
        array = np.moveaxis(array, 0, -1)
    _store(path, array, volume, record, "", extra)


def _write_tensors(path: Path, volume: TensorVolume, provenance: Mapping[str, Any] | None) -> None:
    """Write masked symmetric matrices, with the mask as confidence and the voxel axes as measurement frame."""
    require_symmetric(volume)
    confidence = volume.inside[..., None].astype(volume.tensors.dtype)
    components = np.concatenate([confidence, pack(volume.tensors, "fsl")], axis=-1)
    record = describe_tensors(volume, "nrrd", "measurement", provenance)
    kind = f"{volume.dimension}D-masked-symmetric-matrix"
    _store(path, np.moveaxis(components, -1, 0), volume, record, kind, {})


def _store(path: Path, array: np.ndarray, volume: TensorVolume, record: str, kind: str, more: dict[str, Any]) -> None:
    """Write an array over the voxels of a volume, in the space right-anterior-superior if the volume has an affine.

    If `kind` is not empty, the first axis of the array has tensor components of this NRRD kind; otherwise, the last
    axis may have times. A slice with an affine must be one voxel thick. The header has the arrays in `more` as text.
    """
    nrrd = optional("nrrd")
    placed = volume.affine is not None and not kind.startswith("2D")
    if volume.affine is not None and not placed:
        warn_of_accuracy(f"{path.name}: NRRD has no position in space for 2×2 tensors. Use .npz or .vti to keep it")
    if placed:
        d, linear, origin = 3, volume.volume_affine[:3, :3], volume.volume_affine[:3, 3]
    else:
        d = volume.dimension
        linear, origin = np.diag(volume.spacing), np.asarray(volume.origin)
    # pynrrd writes a direction of NaN as "none", the value for axes without a direction in space.
    directions, kinds, none = linear.T, ["space"] * d, np.full((1, d), np.nan)
    header: dict[str, Any] = {"space": "right-anterior-superior"} if placed else {"space dimension": d}
    if kind:
        directions, kinds = np.concatenate([none, directions]), [kind, *kinds]
        header["measurement frame"] = nearest_rotation(linear).T  # NRRD lists this matrix by columns
    elif array.ndim > d:
        directions, kinds = np.concatenate([directions, none]), [*kinds, "list"]
    if volume.length_unit:
        header["space units"] = ["mm"] * d
    header |= {"space directions": directions, "space origin": origin, "kinds": kinds, "encoding": "gzip"}
    header |= {key: " ".join(map(repr, np.ravel(value).tolist())) for key, value in more.items()}
    with atomic_path(path) as temporary:
        nrrd.write(str(temporary), array, {**header, "provenance": record}, index_order="F")


def _tensor_axis(name: str, shape: tuple[int, ...], header: Mapping[str, Any]) -> tuple[int, str | None]:
    """Return the axis of the components, and its kind or None if the file declares none."""
    kinds = header.get("kinds", ["???"] * len(shape))
    matrix_axes = [(axis, kind) for axis, kind in enumerate(kinds) if kind in KINDS]
    if len(matrix_axes) == 1:
        axis, kind = matrix_axes[0]
        if shape[axis] != KINDS[kind]:
            raise ValueError(f"{name}: got axis {axis}, a {kind}, of {shape[axis]} components; expected {KINDS[kind]}")
        return axis, kind
    count = {4: 6, 3: 3}.get(len(shape))
    rows = _rows(header, len(shape))
    outside = [a for a in range(len(shape)) if shape[a] == count and rows is not None and np.isnan(rows[a]).all()]
    outside = outside or [a for a in (0, len(shape) - 1) if shape[a] == count]
    if matrix_axes or len(outside) != 1:
        raise ValueError(
            f"{name}: got axes of sizes {tuple(shape)} and kinds {list(kinds)}; expected one axis of components of the "
            f"kind {', '.join(KINDS)}, or one axis of six components (three in the plane)"
        )
    return outside[0], None


def _rows(header: Mapping[str, Any], n: int) -> Float[np.ndarray, "n d"] | None:
    """Return the direction of each axis, or NaN for an axis without one; None if the file gives no directions."""
    given = header.get("space directions")
    if given is None:
        return None
    d = next((len(row) for row in given if row is not None), 0)
    return np.array([np.full(d, np.nan) if row is None else row for row in given], np.float64).reshape(n, d)


def _placement(name: str, header: Mapping[str, Any], domain: list[int]) -> Placement:
    d, rows = len(domain), _rows(header, int(header["dimension"]))
    unit, scales = _lengths(name, header, domain)
    measured = np.asarray(header.get("measurement frame", np.nan), np.float64).T  # NRRD lists this matrix by columns
    frame = measured if np.isfinite(measured).all() else None
    if rows is None:
        spacings = np.asarray(header.get("spacings", np.full(int(header["dimension"]), np.nan)), np.float64)[domain]
        directions = np.diag(np.where(np.isnan(spacings), 1.0, spacings * scales))
        return Placement(directions, np.zeros(d), None, frame, False, unit)
    directions = rows[domain].T
    if directions.shape != (d, d) or not np.isfinite(directions).all() or np.linalg.norm(directions, axis=0).min() == 0:
        raise ValueError(
            f"{name}: got space directions {rows[domain].tolist()}; expected {d} nonzero vectors of {d} finite numbers"
        )
    origin = np.asarray(header.get("space origin", np.zeros(d)), np.float64)
    if origin.shape != (d,):
        raise ValueError(f"{name}: got space origin {origin.tolist()}; expected {d} numbers")
    origin = scales * np.nan_to_num(origin)
    signs = _PATIENT.get(_space_of(header)) if d == 3 else None
    to_ras = None if signs is None else np.array(signs)
    return Placement(scales[:, None] * directions, origin, to_ras, frame, True, unit)


def _lengths(name: str, header: Mapping[str, Any], domain: list[int]) -> tuple[str, Float[np.ndarray, " d"]]:
    """Return the file's unit of length, or the empty text, and its size in mm for each axis."""
    field = "space units" if "space directions" in header else "units"
    listed = list(header.get(field, ()))
    given = listed[: len(domain)] if field == "space units" else [listed[axis] for axis in domain if listed]
    scales = [millimetres(f"{name}: {field}", str(text)) for text in given]
    declared = [text for text, scale in zip(given, scales, strict=True) if scale is not None]
    if not declared:
        return "", np.ones(len(domain))
    if len(declared) < len(domain):
        raise ValueError(f"{name}: got {field} {given}; expected a unit for each of {len(domain)} axes, or no unit")
    return " ".join(dict.fromkeys(declared)), np.array(scales, np.float64)


def _to_voxel_axes(
    name: str, tensors: Float[np.ndarray, "*shape d d"], frame: str | None, place: Placement, notes: list[str]
) -> tuple[Float[np.ndarray, "*shape d d"], str]:
    """Return the tensors with components along the voxel axes, and the frame of the components in the file."""
    d, directions, columns = tensors.shape[-1], place.directions, place.measured
    if columns is None:
        if frame == "measurement":
            raise ValueError(f'frame: got {frame!r}, but {name} has no measurement frame; expected "voxel" or "world"')
        rotation = nearest_rotation(directions)
        # If all voxel axes have the directions of the space's axes, or all are reversed, "voxel" and "world" agree.
        same = np.allclose(rotation, np.eye(d), atol=1e-6) or np.allclose(rotation, -np.eye(d), atol=1e-6)
        if frame is None and not same:
            raise ValueError(
                f"{name}: got no measurement frame, and voxel axes that differ from the axes of space; expected a "
                f"frame. Pass {argument('frame', 'world')} (the axes of space, as in ITK and 3D Slicer) or "
                f"{argument('frame', 'voxel')}"
            )
        frame = frame or ("world" if place.placed else "voxel")
    elif frame in (None, "measurement"):
        if columns.shape != (d, d):
            raise ValueError(f"{name}: got a measurement frame of shape {columns.shape}; expected {(d, d)}")
        if np.abs(columns.T @ columns - np.eye(d)).max() > 1e-3:
            notes.append("the measurement frame is not orthonormal and scales the tensors, as NRRD defines")
        columns = columns.astype(tensors.dtype)
        return to_voxel_axes(columns @ tensors @ columns.T, "world", directions), "measurement"
    else:
        notes.append(f"components read along the {frame} axes, as asked; the file declares a measurement frame")
    if frame == "fsl" and place.signs is not None:  # FSL's convention refers to right, anterior, superior
        directions = place.signs[:, None] * directions
    return to_voxel_axes(tensors, frame, directions), frame


_NAMES = (".nrrd", ".nhdr")
FORMAT = Format(_NAMES, _read_tensors, ("confidence",), _read_image, (".nrrd",), _write, _write_tensors, image=".nrrd")
