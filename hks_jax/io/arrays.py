"""Read and write tensors in NumPy's file formats, .npz and .npy."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from hks_jax.domain.grid import per_axis
from hks_jax.io.tensor_order import Matrices, matrices, to_voxel_axes
from hks_jax.io.units import in_mm2_per_s, unit_in, unknown_unit
from hks_jax.io.volume import Format, TensorVolume, describe_tensors, mask_in_file, require_affine, spacing_of
from hks_jax.storage import load_npy, load_npz, write_npz


def _read_image(name: str) -> tuple[np.ndarray, np.ndarray | None, str]:
    """Return the array of an npy or the array ``mask`` of an npz, its affine if it is a volume's, and no unit ("")."""
    if name.lower().endswith(".npy"):
        return load_npy(name), None, ""
    arrays = load_npz(name)
    if "mask" not in arrays:
        raise ValueError(f"{name}: got the arrays {', '.join(sorted(arrays)) or 'none'}; expected an array 'mask'")
    if "affine" not in arrays or arrays["mask"].ndim != 3:  # a slice's affine is not that of its volume
        return arrays["mask"], None, ""
    affine = _real(f"{name}: affine", arrays["affine"])
    require_affine(name, affine)
    return arrays["mask"], affine, ""


def _read_tensors(
    name: str, order: str | None, frame: str | None, array: str | None, spacing: float | Sequence[float] | None
) -> TensorVolume:
    wanted = array or "tensors"
    if name.lower().endswith(".npy"):
        arrays: Mapping[str, Any] = {wanted: load_npy(name)}
    else:
        arrays = load_npz(name)
    if wanted not in arrays:
        raise ValueError(
            f"{name}: got the arrays {', '.join(sorted(arrays)) or 'none'}; expected {wanted!r} of shape "
            "(*shape, d, d). The file may also have 'spacing', 'origin', 'mask', 'affine', 'order' and 'frame'"
        )
    values = arrays[wanted]
    if values.dtype != np.float32:
        values = _real(f"{name}: {wanted}", values)
    order = order or _text(arrays, "order") or None
    if (values.ndim, values.shape[-1:]) in ((4, (6,)), (3, (3,))):
        found = matrices(name, values, order)
    elif order in (None, "matrix"):
        found = Matrices(values, "matrix", None)
    else:
        raise ValueError(f"order: got {order!r}, but {name} holds whole matrices. Leave this argument out")
    frame = frame or _text(arrays, "frame") or "voxel"
    if frame != "voxel":
        if "affine" not in arrays or found.tensors.shape[-1] != 3:
            raise ValueError(f'frame: got {frame!r}, but {name} has no 3×3 tensors with an affine; expected "voxel"')
        found = found._replace(tensors=to_voxel_axes(found.tensors, frame, _real(f"{name}: affine", arrays["affine"])))
    if spacing is not None and "spacing" in arrays:
        raise ValueError(f"spacing: {name} declares {np.asarray(arrays['spacing']).tolist()}. Leave this argument out")
    given = arrays if spacing is None else {**arrays, "spacing": spacing}
    about = {"order": found.order, "frame": frame, "source": name, "invalid_by_order": found.invalid}
    return volume_of(name, given, found.tensors, **about)


def volume_of(name: str, arrays: Mapping[str, Any], tensors: Float[np.ndarray, "..."], **about: Any) -> TensorVolume:
    """Return a volume of `tensors` with the arrays of `place_of`.

    By default, spacing is that of the affine or, without an affine, 1; and origin is 0.
    """
    mask, affine, axis = (arrays.get(name) for name in ("mask", "affine", "slice_axis"))
    d, text = tensors.shape[-1] if tensors.ndim else 0, _text(arrays, "unit")
    unit, spacing = unit_in(text), arrays.get("spacing")
    affine = None if affine is None else _real(f"{name}: affine", affine)
    axis = None if axis is None else np.asarray(axis).tolist()
    if spacing is None:  # `TensorVolume` refuses an affine and an axis that are wrong
        spacing = 1.0
        if affine is not None and affine.shape == (4, 4) and axis in (None, 0, 1, 2):
            spacing = spacing_of(affine, d, axis)
    if text and unit is None:
        raise ValueError(f"{name}: {unknown_unit(text)}")
    volume = TensorVolume(
        tensors,
        per_axis(f"{name}: spacing", spacing, d),
        per_axis(f"{name}: origin", arrays.get("origin", 0.0), d),
        None if mask is None else mask_in_file(f"{name}: mask", mask),
        affine,
        axis,
        length_unit=_text(arrays, "length_unit"),
        **about,
    )
    return volume if unit is None else in_mm2_per_s(volume, unit, "which the file declares")


def _write(path: Path, array: np.ndarray, volume: TensorVolume, name: str, extra: dict[str, Any], record: str) -> None:
    write_npz(path, {**place_of(volume), name: array, **extra, "provenance": record})


def _write_tensors(path: Path, volume: TensorVolume, provenance: Mapping[str, Any] | None) -> None:
    record = describe_tensors(volume, "matrix", "voxel", provenance)
    write_npz(path, {"tensors": volume.tensors, **place_of(volume), "frame": "voxel", "provenance": record})


def place_of(volume: TensorVolume) -> dict[str, Any]:
    """Return, by name, the arrays that define the position of a volume's voxels, its mask, and its known units."""
    optional: dict[str, Any] = {"mask": volume.mask, "affine": volume.affine, "slice_axis": volume.slice_axis}
    optional |= {"length_unit": volume.length_unit or None, "unit": volume.unit or None}
    given = {key: value for key, value in optional.items() if value is not None}
    return {"spacing": volume.spacing, "origin": volume.origin, **given}


def _text(arrays: Mapping[str, Any], key: str) -> str:
    return str(np.asarray(arrays.get(key, "")))


def _real(name: str, value: Any) -> Float[np.ndarray, "..."]:
    array = np.asarray(value)
    if array.dtype.kind not in "fiu":
        raise ValueError(f"{name}: got dtype {array.dtype}; expected real numbers")
    return array.astype(np.float64)


FORMAT = Format((".npz", ".npy"), _read_tensors, ("array", "spacing"), _read_image, (".npz",), _write, _write_tensors)
