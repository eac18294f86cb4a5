"""VTK's image data (.vti, and structured points in .vtk) through VTK, which is optional."""

import os
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from jaxtyping import Bool

from hks_jax.atomic import atomic_path
from hks_jax.io.tensor_order import choices, invalid_by_order, nearest_rotation, to_voxel_axes, unpack
from hks_jax.io.volume import TensorVolume, as_mask, describe_tensors
from hks_jax.io.vtk_checks import check_legacy, check_xml
from hks_jax.optional import optional
from hks_jax.reading import existing, reading

SUFFIXES = (".vti", ".vtk")
WRITTEN = (".vti",)
IMAGE = ".vti"
OPTIONS = ("array",)


def holds_dataset(path: str | os.PathLike[str], kind: str) -> bool:
    """Tell whether a legacy .vtk file holds a dataset of this kind, such as STRUCTURED_POINTS."""
    with open(path, "rb") as stream:
        head = stream.read(1024)
    return head.startswith(b"# vtk DataFile") and kind.encode() in head.upper()


def load(path: str | os.PathLike[str]) -> Any:
    """Return the vtkImageData of a file.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not image data, or a damaged file.
    """
    optional("vtkmodules.vtkIOXML")
    from vtkmodules.vtkIOLegacy import vtkStructuredPointsReader
    from vtkmodules.vtkIOXML import vtkXMLImageDataReader

    file = existing(path)
    name, errors = str(file), list[str]()

    def remember(source: Any, event: str, message: str) -> None:
        errors.append(message.split("): ")[-1].strip())

    remember.CallDataType = "string0"  # type: ignore[attr-defined]
    # VTK prints what its parts find wrong, and ends the process for want of memory: what it would stumble over is
    # looked at first.
    with reading(file, "readable VTK image data (.vti, or structured points in .vtk)"):
        if name.lower().endswith(".vti"):
            check_xml(file, "ImageData")
            reader: Any = vtkXMLImageDataReader()
        else:
            if not holds_dataset(name, "STRUCTURED_POINTS"):
                raise ValueError("no dataset STRUCTURED_POINTS in the first kilobyte")
            check_legacy(file)
            reader = vtkStructuredPointsReader()
        for event in ("ErrorEvent", "WarningEvent"):
            reader.AddObserver(event, remember)
        reader.SetFileName(name)
        reader.Update()
        if errors:
            raise ValueError(errors[0])
    return reader.GetOutput()


def read_tensors(name: str, order: str | None, frame: str | None, array: str | None) -> TensorVolume:
    """Read tensors; see `hks_jax.io.read_tensors`."""
    image = load(name)
    from vtkmodules.util.numpy_support import vtk_to_numpy

    at_points = _has_candidates(image.GetPointData(), array) or not _has_candidates(image.GetCellData(), array)
    attributes = image.GetPointData() if at_points else image.GetCellData()
    chosen, declared = _tensor_array(name, attributes, array)
    if name.lower().endswith(".vtk"):
        _check_length(name, chosen)
    components = np.asarray(vtk_to_numpy(chosen))
    components = components.astype(np.result_type(components.dtype, np.float32), copy=False)
    if components.shape[-1] == 9:
        if order is not None:
            raise ValueError(f"order: {name} holds whole matrices; leave this out")
        tensors, order = components.reshape(-1, 3, 3), "matrix"
    elif order is None and not declared:
        raise ValueError(
            f"{name}: six components in {chosen.GetName()!r}, which the file does not declare as tensors, and programs "
            f"differ in their order. Pass order (--order), one of {choices()}"
        )
    else:
        order = order or "vtk"
        tensors = unpack(components, order)
    lower, upper = np.array(image.GetExtent()).reshape(3, 2).T
    thick = upper > lower
    shape = tuple((upper - lower + np.where(thick & (not at_points), 0, 1)).tolist())
    first = lower + np.where(thick & (not at_points), 0.5, 0.0)  # a cell's value is at its centre
    steps = np.array(image.GetSpacing())
    steps[(steps == 0) & ~thick] = 1.0  # as some programs write what has no thickness
    affine = np.eye(4)
    affine[:3, :3] = np.array([[image.GetDirectionMatrix().GetElement(i, j) for j in range(3)] for i in range(3)])
    affine[:3, :3] *= steps
    spacing = np.linalg.norm(affine[:3, :3], axis=0)
    if not (np.isfinite(affine).all() and spacing.min() > 0):
        raise ValueError(f"{name}: got spacing {image.GetSpacing()}; expected finite numbers, none of them zero")
    affine[:3, 3] = np.array(image.GetOrigin()) + affine[:3, :3] @ first
    frame = frame or "world"
    place = "points" if at_points else "cells"
    what = "whole matrices" if order == "matrix" else f'components in order "{order}"'
    note = f"{what} from {chosen.GetName()!r} at the {place}, given along the {frame} axes, taken to the voxel axes"
    straight = np.array_equal(affine[:3, :3], np.diag(spacing))
    volume = TensorVolume(
        np.ascontiguousarray(to_voxel_axes(_on_grid(tensors, shape), frame, affine)),
        tuple(spacing.tolist()),
        tuple(affine[:3, 3].tolist()) if straight else (0.0,) * 3,
        _mask(attributes, shape),
        None if straight else affine,
        order=order,
        frame=frame,
        notes=(note,),
        source=name,
        invalid_by_order=None if order == "matrix" else invalid_by_order(components, order),
    )
    return _as_plane(volume)


def write(
    path: Path, array: np.ndarray, volume: TensorVolume, name: str, extra: Mapping[str, Any], record: str
) -> None:
    """Write scalars as arrays of points, one per time; see `hks_jax.io.save`."""
    _write(path, by_time(name, array, array.ndim - volume.dimension, extra), volume, record, extra)


def write_tensors(path: Path, volume: TensorVolume, provenance: Mapping[str, Any] | None) -> None:
    """Write tensors, along the axes of space; those of a slice with zeros out of its plane."""
    tensors = volume.tensors
    if volume.dimension == 2:
        keep = [a for a in range(3) if a != volume.thin_axis]
        tensors = np.zeros((*volume.shape, 3, 3), tensors.dtype)
        tensors[..., np.ix_(keep, keep)[0], np.ix_(keep, keep)[1]] = volume.tensors
    rotation = nearest_rotation(volume.volume_affine[:3, :3]).astype(tensors.dtype)
    record = describe_tensors(volume, "matrix", "world", provenance)
    _write(path, {"tensors": rotation @ tensors @ rotation.T}, volume, record)


def by_time(name: str, array: np.ndarray, n: int, extra: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Return one array per time, where `n` is 1, by names that say which."""
    if n == 0:
        return {name: array}
    times = np.ravel(extra.get("times", ()))
    labels = [f"{name}_{i}" + (f"_t{times[i]:.6g}" if len(times) == len(array) else "") for i in range(len(array))]
    return dict(zip(labels, array, strict=True))


def _write(
    path: Path,
    arrays: Mapping[str, np.ndarray],
    volume: TensorVolume,
    record: str,
    more: Mapping[str, Any] | None = None,
) -> None:
    """Write point arrays over the voxels of a volume, the mask, and `more` and the provenance as field data.

    Arrays are (*shape,) or (*shape, 3, 3), the latter as tensors along the axes of space.
    """
    optional("vtkmodules.vtkIOXML")
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonCore import vtkStringArray
    from vtkmodules.vtkCommonDataModel import vtkImageData
    from vtkmodules.vtkIOXML import vtkXMLImageDataWriter

    affine = volume.volume_affine
    spacing = np.linalg.norm(affine[:3, :3], axis=0)
    shape = np.array(volume.shape) if volume.dimension == 3 else np.insert(volume.shape, volume.thin_axis, 1)
    image = vtkImageData()
    image.SetDimensions(*shape.tolist())
    image.SetSpacing(*spacing.tolist())
    image.SetOrigin(*affine[:3, 3].tolist())
    image.SetDirectionMatrix(*(affine[:3, :3] / spacing).ravel().tolist())
    masks = {} if volume.mask is None else {"mask": volume.mask.astype(np.uint8)}
    for name, values in {**arrays, **masks}.items():
        tail = values.shape[volume.dimension :]
        ordered = np.moveaxis(values.reshape(*shape, *tail), (0, 1, 2), (2, 1, 0)).reshape(-1, *tail)
        array = numpy_to_vtk(np.ascontiguousarray(ordered.reshape(len(ordered), -1)), deep=True)
        array.SetName(name)
        if tail:
            image.GetPointData().SetTensors(array)
        else:
            image.GetPointData().AddArray(array)
    for name, values in (more or {}).items():
        array = numpy_to_vtk(np.ascontiguousarray(np.asarray(values).ravel()), deep=True)
        array.SetName(name)
        image.GetFieldData().AddArray(array)
    text = vtkStringArray()
    text.SetName("provenance")
    text.InsertNextValue(record)
    image.GetFieldData().AddArray(text)
    with atomic_path(path) as temporary:
        writer = vtkXMLImageDataWriter()
        writer.SetFileName(str(temporary))
        writer.SetInputData(image)
        if not writer.Write():
            raise OSError(f"{path}: VTK could not write it")


def _check_length(name: str, array: Any) -> None:
    """Raise ValueError where a legacy file ends before an array does, which VTK hardly notices."""
    content = Path(name).read_bytes()
    key = re.escape(quote(array.GetName()).encode())
    line = re.search(rb"\n(?:(?:TENSORS6?|SCALARS) " + key + rb" \w+.*|" + key + rb" \d+ \d+ \w+.*)\n", content)
    if line is None:
        return  # a name that is written otherwise: nothing to measure from
    values = content[line.end() :]
    count = array.GetNumberOfTuples() * array.GetNumberOfComponents()
    text = b"ASCII" in content.split(maxsplit=40)[:40]
    if len(values.split(maxsplit=count)) < count if text else len(values) < count * array.GetDataTypeSize():
        raise ValueError(f"{name}: incomplete; it ends before the {count} values of {array.GetName()!r} do")


def _arrays(attributes: Any) -> dict[str, Any]:
    arrays = [attributes.GetArray(i) for i in range(attributes.GetNumberOfArrays())]
    return {array.GetName(): array for array in arrays if array is not None}


def _has_candidates(attributes: Any, name: str | None) -> bool:
    return any(a.GetNumberOfComponents() in (6, 9) for key, a in _arrays(attributes).items() if name in (None, key))


def _tensor_array(name: str, attributes: Any, wanted: str | None) -> tuple[Any, bool]:
    """Return the array of tensors, and whether the file declares it as such."""
    declared = attributes.GetTensors()
    candidates = {key: a for key, a in _arrays(attributes).items() if a.GetNumberOfComponents() in (6, 9)}
    if wanted is None and declared is not None:
        return declared, True
    if wanted is not None:
        candidates = {key: a for key, a in candidates.items() if key == wanted}
    if len(candidates) != 1:
        had = ", ".join(f"{key!r} ({a.GetNumberOfComponents()})" for key, a in _arrays(attributes).items()) or "none"
        asked = "" if wanted is None else f" named {wanted!r}"
        raise ValueError(
            f"{name}: expected one array of 6 or 9 components{asked}; it has (with components) {had}. Pass array"
        )
    array = next(iter(candidates.values()))
    return array, declared is not None and array.GetName() == declared.GetName()


def _on_grid(values: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return values (n, …) as (*shape, …): the first axis runs fastest in VTK."""
    return np.moveaxis(values.reshape(*shape[::-1], *values.shape[1:]), (0, 1, 2), (2, 1, 0))


def _mask(attributes: Any, shape: tuple[int, ...]) -> Bool[np.ndarray, "nx ny nz"] | None:
    from vtkmodules.util.numpy_support import vtk_to_numpy

    array = _arrays(attributes).get("mask")
    return None if array is None else as_mask("mask", np.ascontiguousarray(_on_grid(vtk_to_numpy(array), shape)))


def _as_plane(volume: TensorVolume) -> TensorVolume:
    """Return a field in a plane as one: an image one voxel thick whose tensors vanish across it."""
    size = np.abs(volume.tensors).max()
    rounding = 100 * np.finfo(volume.tensors.dtype).eps * size  # of turning to the voxel axes
    for axis in range(3):
        if volume.shape[axis] == 1 and size > 0 and np.abs(volume.tensors[..., axis, :]).max() <= rounding:
            plane = volume.slice(("x", "y", "z")[axis], 0)
            affine = volume.volume_affine if volume.origin[axis] else volume.affine
            return replace(plane, affine=affine, notes=(*volume.notes, "a field in the plane: no components across it"))
    return volume
