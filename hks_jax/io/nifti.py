"""Read and write NIfTI through the optional library nibabel; tensors may be in six images of one component each."""

import json
import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hks_jax.accuracy import warn_of_accuracy
from hks_jax.io.json_files import write_json
from hks_jax.io.plausibility import undeclared_frame
from hks_jax.io.repair import require_symmetric
from hks_jax.io.tensor_order import FRAMES, ORDERS, Frame, Order, matrices, pack
from hks_jax.io.units import UNITS, Unit, by_axis, in_mm2_per_s, unit_in
from hks_jax.io.volume import AXES, Format, TensorVolume, corners, describe_tensors, images_of, own_record, placed
from hks_jax.naming import argument
from hks_jax.optional import optional
from hks_jax.storage import UnsuitedError, atomic_path, content_of, reading

SUFFIXES = (".nii", ".nii.gz")
SYMMETRIC_MATRIX = 1005
"""NIfTI's intent code for symmetric matrices."""
COMMENT = 6
"""NIfTI's code for a comment in an extension of the header."""
_LENGTHS = {0: ("", 1.0), 1: ("m", 1e3), 2: ("mm", 1.0), 3: ("um", 1e-3)}
"""The unit of length for each code in NIfTI's xyzt_units, and its size in mm. Code 0, no unit, is read as mm
if another program wrote the file; the record of `save_tensors` tells whether the unit is known."""
_HEADERS_OF_2 = (b"\x1c\x02\0\0", b"\0\0\x02\x1c")
"""The first bytes of NIfTI-2, the size of its header in both byte orders."""
REPETITION_TIME = "RepetitionTime"
"""BIDS's name of the time between the images of a series, in seconds."""
SCALAR = {"Type": "scalar"}
"""The entry OrientationEncoding that the draft of BIDS for diffusion derivatives (BIDS Extension Proposal 16) requires
for images of more than three dimensions, here if the fourth axis has times, and not directions."""
_REFERENCES = {"ijk": "voxel", "bvec": "fsl", "xyz": "world", "scanner": "world"}
"""The frame for each value of Reference in BIDS's field OrientationEncoding, including values from drafts of BIDS."""
_COMPONENT = re.compile(r"(?:^|[_.-])(?:dt|t|d)?(xx|xy|xz|yy|yz|zz)(?=[_.])", re.IGNORECASE)
"""The pattern of the component in a file's name, as BIDS (``param-txx``), DSI Studio and ANTs write it."""


def is_nifti(path: str | os.PathLike[str]) -> bool:
    """Return whether a path has a suffix of NIfTI."""
    return os.fspath(path).lower().endswith(SUFFIXES)


def load(name: str) -> tuple[Any, np.ndarray]:
    """Return a NIfTI image and its scaled voxel values; check its length and the checksum of a compressed file.

    The values are in float32 if nibabel returns float32, otherwise in float64.
    """
    nib = optional("nibabel")
    with reading(name, "a readable NIfTI image") as file:
        with open(file, "rb") as stream:
            compressed = stream.read(2) == b"\x1f\x8b"
        if compressed or file.name.lower().endswith(".gz"):  # the content counts, because nibabel goes by the name
            content = content_of(file)
            kind = nib.Nifti2Image if content[:4] in _HEADERS_OF_2 else nib.Nifti1Image
            image, length = kind.from_bytes(content), len(content)
        else:
            image, length = nib.load(file), file.stat().st_size
        stored = image.dataobj
        declared = stored.offset + math.prod(image.shape) * stored.dtype.itemsize
        if declared != length:
            raise ValueError(f"got {length} bytes; expected {declared} for {stored.dtype} of shape {image.shape}")
        _warn_of_zero_spacing(name, image)
        data = np.asarray(stored)
        if data.dtype.kind not in "fiub":
            raise UnsuitedError(f"got voxels of type {data.dtype}; expected real numbers")
    dtype = data.dtype if data.dtype.kind == "f" and data.dtype.itemsize in (4, 8) else np.dtype(np.float64)
    return image, np.ascontiguousarray(data, dtype=dtype.newbyteorder("="))


def _warn_of_zero_spacing(name: str, image: Any) -> None:
    """Warn if the header has a voxel size of zero, which nibabel replaces by 1, and no sform gives the voxel sizes."""
    if int(image.header["sform_code"]) > 0:
        return
    with image.file_map["image"].get_prepare_fileobj("rb") as stream:
        stored = type(image.header).from_fileobj(stream, check=False)["pixdim"][1:4]
    if axes := ", ".join(axis for axis, size in zip(AXES, stored[: len(image.shape)], strict=False) if size == 0):
        warn_of_accuracy(
            f"{name}: the header gives the voxel size 0 along {axes} and no sform; the size 1 is assumed. Correct the "
            "header's pixdim"
        )


def repetition_time(path: str | os.PathLike[str]) -> dict[str, float]:
    """Return the time between the images of a series in seconds, by BIDS's name; empty if the file declares none."""
    if not is_nifti(path):
        return {}
    header = optional("nibabel").load(os.fspath(path)).header
    scale = {8: 1.0, 16: 1e-3, 24: 1e-6}.get(int(header["xyzt_units"]) & 56)
    step = float(header["pixdim"][4])
    return {REPETITION_TIME: step * scale} if scale and len(header.get_data_shape()) == 4 and step > 0 else {}


def affine_in_mm(name: str, image: Any) -> tuple[np.ndarray, str]:
    """Return the affine with lengths in mm, and the unit of length that the file declares (empty if it has none)."""
    code = int(image.header["xyzt_units"]) & 7
    if code not in _LENGTHS:
        raise ValueError(f"{name}: got the code {code} for the unit of length; expected 0 to 3. Correct xyzt_units")
    unit, scale = _LENGTHS[code]
    return np.diag([scale, scale, scale, 1.0]) @ np.asarray(image.affine, np.float64), unit


def _read_image(name: str) -> tuple[np.ndarray, np.ndarray, str]:
    image, voxels = load(name)
    return voxels, *affine_in_mm(name, image)


def sidecar_of(path: str | os.PathLike[str]) -> Path:
    """Return the path of an image's BIDS sidecar, whether or not that file exists."""
    return Path(os.fspath(path).removesuffix(".gz")).with_suffix(".json")


def _in_sidecar(path: str) -> dict[str, Any]:
    """Return the content of an image's sidecar, or an empty dictionary."""
    sidecar = sidecar_of(path)
    if not sidecar.is_file():
        return {}
    with reading(sidecar, "a BIDS sidecar in JSON"):
        content = json.loads(sidecar.read_text(encoding="utf-8"))
    return content if isinstance(content, dict) else {}


class Declared(NamedTuple):
    """The order, the axes and the unit of tensors that BIDS metadata declare; an undeclared entry is None."""

    order: Order | None
    frame: Frame | None
    unit: Unit | None


def declared_in(metadata: Mapping[str, Any]) -> Declared:
    """Return the order, the axes and the unit of tensors that metadata of BIDS declare."""
    encoding, units = metadata.get("OrientationEncoding"), metadata.get("Units")
    encoding = encoding if isinstance(encoding, dict) else {}
    frame: Any = _REFERENCES.get(str(encoding.get("Reference")))
    unit = unit_in(units) if isinstance(units, str) else None
    return Declared("fsl" if encoding.get("Type") == "tensor" else None, frame, unit)  # FSL's: xx xy xz yy yz zz


def _by_sidecar(path: str) -> Declared:
    """Return what an image's sidecar declares; raise ValueError if its Reference is unknown."""
    content = _in_sidecar(path)
    encoding = content.get("OrientationEncoding")
    reference = encoding.get("Reference") if isinstance(encoding, dict) else None
    if reference is not None and not (isinstance(reference, str) and reference in _REFERENCES):
        raise ValueError(
            f"{sidecar_of(path)}: got the Reference {reference!r}; expected one of {', '.join(_REFERENCES)}. Edit or "
            "remove it"
        )
    return declared_in(content)


def with_units(volume: TensorVolume, path: str, unit: Unit | None) -> TensorVolume:
    """Return a volume in mm²/s if its image's sidecar declares its unit; `unit` overrides the sidecar.

    The sidecar may describe an earlier image of the same name, so the unit in the image's own record counts first.
    """
    content = _in_sidecar(path) if is_nifti(path) and not volume.unit else {}
    text, declared = content.get("Units"), declared_in(content).unit
    if not isinstance(text, str):
        return volume if unit is None else in_mm2_per_s(volume, unit)
    if declared is not None and unit in (None, declared):
        return in_mm2_per_s(volume, declared, "which the sidecar declares")
    if unit is None:
        note = f"the Units {text!r} of the sidecar are ignored; known are {', '.join(UNITS)}"
    else:
        volume = in_mm2_per_s(volume, unit)
        note = f"the unit of the tensors is {unit}, as asked; the sidecar declares {text!r}"
    return replace(volume, notes=(*volume.notes, note))


def _own_record(image: Any, affine: np.ndarray) -> dict[str, Any]:
    """Return the record of `save_tensors`, or an empty one if another program wrote or reoriented the image."""
    for extension in image.header.extensions:
        record = own_record(extension.get_content()) if extension.get_code() == COMMENT else {}
        if "axes" in record and np.allclose(record["axes"], affine[:3, :3], rtol=1e-4, atol=1e-4):
            return record
    return {}


def read_tensors(name: str, order: str | None, frame: str | None) -> TensorVolume:
    """Read tensors from a file; see `hks_jax.io.read_tensors`."""
    image, voxels = load(name)
    return _tensors_of(name, image, voxels, order, frame)


def _tensors_of(name: str, image: Any, voxels: np.ndarray, order: str | None, frame: str | None) -> TensorVolume:
    shape = image.shape
    if shape[3:] not in ((6,), (1, 6)):
        remedy = "Fit tensors to diffusion-weighted images first by hks_jax.io.fit_dwi, or by --bval and --bvec"
        if shape[3:] == (8,):
            remedy += ". Camino writes an exit code and log S₀ before the tensor: remove both, and pass "
            remedy += argument("order", "fsl")
        raise ValueError(
            f"{name}: got an image of shape {shape}; expected six components per voxel, (nx, ny, nz, 1, 6) or "
            f"(nx, ny, nz, 6). {remedy}"
        )
    declared = int(image.header["intent_code"]) == SYMMETRIC_MATRIX
    affine, length_unit = affine_in_mm(name, image)
    by_sidecar, record, notes = _by_sidecar(name), _own_record(image, affine) if declared else {}, list[str]()
    found = matrices(name, voxels.reshape(*shape[:3], 6), order, "nifti" if declared else by_sidecar.order or "")
    if declared and found.order != "nifti":
        notes.append(f'components read in order "{order}", as asked; the file declares NIfTI\'s symmetric-matrix order')
    declared_frame = record.get("frame", by_sidecar.frame)
    if declared_frame not in (None, "voxel", "fsl", "world"):
        raise ValueError(f'{name}: the header declares {declared_frame!r} axes; expected "voxel", "fsl" or "world"')
    if by_sidecar.frame not in (None, declared_frame):  # the sidecar may describe an earlier image of the same name
        notes.append(
            f"the {by_sidecar.frame} axes of the sidecar are ignored, because the image declares {declared_frame} axes"
        )
    open_frame = frame is None and declared_frame is None and found.order == "nifti"
    if frame is not None and declared_frame not in (None, frame):
        notes.append(f"components read along the {frame} axes, as asked; the file declares the {declared_frame} axes")
    frame = frame or declared_frame or FRAMES[found.order]
    known = {"unit": record.get("unit", ""), "length_unit": record.get("length_unit", "mm")}
    volume = placed(name, found, frame, affine, **known)
    notes += placement_notes(image)
    stored = np.linalg.norm(np.asarray(image.affine, np.float64)[:3, :3], axis=0)
    if length_unit not in ("", "mm"):
        notes.append(f"voxel sizes {by_axis(stored)} converted from {length_unit}, which the file declares, to mm")
    header = np.asarray(image.header.get_zooms()[:3], np.float64)
    if np.abs(header / stored - 1).max() > 1e-3:
        notes.append(f"voxel sizes {by_axis(stored)} taken from the affine; the header's pixdim says {by_axis(header)}")
    if open_frame and np.linalg.det(affine[:3, :3]) > 0:
        notes.append(undeclared_frame())
    return replace(volume, notes=(*notes, *volume.notes))


def component_of(path: str | os.PathLike[str]) -> str | None:
    """Return the component that a file's name states, such as ``"xy"`` for ``dtxy.nii``, or None."""
    names = _COMPONENT.findall(os.path.basename(path))
    return names[-1].lower() if names else None


def siblings(path: str | os.PathLike[str]) -> list[str]:
    """Return the paths of all six images of components if `path` is one of them, or else only `path`.

    Images of one component are NIfTI images with one value per voxel. The names of the six images, such as
    ``dtxx.nii`` and ``dtxy.nii``, differ only in the component.
    """
    name = os.fspath(path)
    if component_of(name) is None or not is_nifti(name) or math.prod(load(name)[0].shape[3:]) != 1:
        return [name]
    folder, file = os.path.split(name)
    start, end = list(_COMPONENT.finditer(file))[-1].span(1)
    own = str.upper if file[start:end].isupper() else str.lower
    names = [os.path.join(folder, file[:start] + own(component) + file[end:]) for component in ORDERS["nifti"]]
    if missing := [os.path.basename(each) for each in names if not os.path.isfile(each)]:
        raise FileNotFoundError(
            f"{name}: the name states one of six components, but these files are missing: {', '.join(missing)}. Put "
            "all six into one folder"
        )
    return names


def described_by(paths: Sequence[str]) -> str:
    """Return the image whose sidecar describes the tensors: the only one, or that of xx among six components."""
    return next((path for path in paths if component_of(path) == "xx"), paths[0])


def read_components(paths: Sequence[str], order: str | None, frame: str | None) -> TensorVolume:
    """Read tensors from six images in any sequence; each file's name states its component.

    If `frame` is None, the BIDS sidecar of the image of xx gives the axes of the components (``Reference`` in
    ``OrientationEncoding``). Without a sidecar, the components are along the voxel axes.
    """
    if order is not None:
        raise ValueError(f"order: got {order!r}, but the names of six images state their components. Leave it out")
    names = ORDERS["nifti"]
    files = {component_of(path): path for path in paths if is_nifti(path)}
    if len(paths) != 6 or set(files) != set(names):
        given = ", ".join(f"{os.path.basename(path)} ({component_of(path) or 'none'})" for path in paths)
        raise ValueError(
            f"files: got {given}; expected six NIfTI images, one for each component {' '.join(names)}. Name the files "
            "by their components, as in sub-01_param-txx_dwimap.nii.gz or dtxx.nii.gz"
        )
    images, voxels = zip(*(load(files[name]) for name in names), strict=True)
    first, affine = images[0], affine_in_mm(files["xx"], images[0])[0]
    for name, image in zip(names, images, strict=True):
        if image.shape != first.shape or math.prod(image.shape[3:]) != 1:
            raise ValueError(
                f"{files[name]}: got shape {image.shape}; expected six images of equal shape with one value per voxel"
            )
        if not np.allclose(affine_in_mm(files[name], image)[0], affine, rtol=1e-4, atol=1e-3):
            raise ValueError(f"{files[name]}: its affine differs from that of {files['xx']}; expected equal affines")
    values = np.stack(voxels, axis=-1).reshape(*first.shape[:3], 1, 6)
    joined = optional("nibabel").Nifti1Image(values, first.affine, first.header)
    joined.header.set_intent(SYMMETRIC_MATRIX, (3,))
    return _tensors_of(files["xx"], joined, values, None, frame)


def placement_notes(image: Any) -> list[str]:
    """Return a note if the position of an image is uncertain: sform and qform differ, or both are missing."""
    by_sform, sform = image.header.get_sform(coded=True)
    by_qform, qform = image.header.get_qform(coded=True)
    if not (sform or qform):
        return ["the file has neither sform nor qform, so left and right are a guess"]
    if not (sform and qform):
        return []
    apart = float(np.linalg.norm(corners(image.shape) @ (by_sform - by_qform).T, axis=1).max())
    if apart <= 0.1 * np.linalg.norm(by_sform[:3, :3], axis=0).min():
        return []
    mirrored = np.linalg.det(by_sform[:3, :3]) * np.linalg.det(by_qform[:3, :3]) < 0
    return [
        f"the positions by the file's sform (code {sform}) and qform (code {qform}) differ by up to {apart:.3g}"
        f"{', and one mirrors the other' * bool(mirrored)}; the sform is used"
    ]


def _write(path: Path, array: np.ndarray, volume: TensorVolume, name: str, extra: dict[str, Any], record: str) -> None:
    others = sorted(extra.keys() - {"times", REPETITION_TIME})
    if others:
        raise ValueError(f"extra: got {', '.join(others)}; expected only times for NIfTI. Write an .npz as well")
    if "times" in extra:
        sources = [Path(volume.source).name] if volume.source else []
        times = np.ravel(extra["times"]).tolist()
        about = {"Quantity": name, "Times": times, "Sources": sources, "OrientationEncoding": SCALAR}
        settings = json.loads(record).get("settings")
        write_json(sidecar_of(path), about | ({"Settings": settings} if settings else {}))
    image = optional("nibabel").Nifti1Image(images_of(array, volume), volume.volume_affine)
    image.header["intent_name"] = name[:15].encode()
    step = extra.get(REPETITION_TIME)
    if step is not None and len(image.shape) == 4:
        image.header.set_zooms((*image.header.get_zooms()[:3], float(step)))
    _store(path, image, record, volume.length_unit, "sec" if step is not None else "unknown")


def _write_tensors(path: Path, volume: TensorVolume, provenance: Mapping[str, Any] | None) -> None:
    if volume.dimension != 3:
        raise ValueError("volume: got a slice, but NIfTI has no 2×2 tensors. Use .npz, .nrrd or .vti")
    require_symmetric(volume)
    components = np.where(volume.inside[..., None, None], pack(volume.tensors, "nifti")[..., None, :], 0)
    image = optional("nibabel").Nifti1Image(components, volume.volume_affine)
    image.header.set_intent(SYMMETRIC_MATRIX, (3,))
    _store(path, image, describe_tensors(volume, "nifti", "voxel", provenance), volume.length_unit)


def _store(path: Path, image: Any, record: str, length_unit: str, time_unit: str = "unknown") -> None:
    nib = optional("nibabel")
    image.header.set_xyzt_units(length_unit or "unknown", time_unit)
    image.header.extensions.append(nib.nifti1.Nifti1Extension("comment", record.encode()))
    with atomic_path(path) as temporary:
        nib.save(image, temporary)


FORMAT = Format(SUFFIXES, read_tensors, (), _read_image, (".nii.gz", ".nii"), _write, _write_tensors, image=".nii.gz")
