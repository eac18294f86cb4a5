"""Read and write image data (.vti, and structured points in .vtk) through the optional library VTK."""

import math
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from hks_jax.io.tensor_order import matrices, nearest_rotation
from hks_jax.io.volume import Format, TensorVolume, describe_tensors, mask_in_file, placed
from hks_jax.naming import argument
from hks_jax.optional import optional
from hks_jax.storage import UnsuitedError, atomic_path, load_npz, reading

_ROOM, _RATIO = 8 << 30, 200
"""The limit of memory for reading an empty file, in bytes, and the increase of the limit per byte of a file."""
_PATIENCE, _SPEED = 60.0, 1e6
"""The limit of time for reading an empty file, in seconds, and the number of bytes that increase the limit by 1 s."""


def load(path: Path) -> dict[str, np.ndarray]:
    """Return the arrays that the script `vtk_child` reads from a file in a separate process."""
    size = path.stat().st_size
    with tempfile.TemporaryDirectory() as folder:
        arrays = Path(folder) / "arrays.npz"
        script = Path(__file__).with_name("vtk_child.py")
        child = subprocess.run(
            [sys.executable, "-P", str(script), str(path), str(arrays), str(_ROOM + _RATIO * size)],
            env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "OPENBLAS_NUM_THREADS": "1"},
            capture_output=True,
            timeout=_PATIENCE + size / _SPEED,
            check=False,
        )
        if child.returncode == 0:
            return load_npz(arrays)
    optional("vtkmodules.vtkIOXML")
    said = child.stderr.decode(errors="replace").splitlines()
    raise ValueError(said[-1] if said and child.returncode > 0 else f"VTK crashed with status {child.returncode}")


def _read_tensors(name: str, order: str | None, frame: str | None, array: str | None) -> TensorVolume:
    with reading(name, "readable VTK image data (.vti, or structured points in .vtk)") as file:
        content, xml = file.read_bytes(), name.lower().endswith(".vti")
        if xml:
            _check_pieces(content)
        image = load(file)
        if "extent" not in image:
            raise ValueError(f"got {image['kind']}; expected image data or structured points")
        if np.abs(image["direction"].T @ image["direction"] - np.eye(3)).max() > 1e-3:
            raise ValueError(f"Direction: got {image['direction'].tolist()}; expected orthonormal columns")
        place, chosen, declared = _tensor_array(image, array)
        components = image[f"{place}:{chosen}"]
        (_check_range if xml else _check_length)(content, chosen, components)
    components = components.astype(np.result_type(components.dtype, np.float32), copy=False)
    found = matrices(name, components, order, "vtk" if declared else "")
    lower, upper = image["extent"].reshape(3, 2).T
    thick = upper > lower
    of_cells = thick & (place == "cell")  # values of cells belong to their centres
    shape = tuple((upper - lower + np.where(of_cells, 0, 1)).tolist())
    steps = np.where((image["spacing"] == 0) & ~thick, 1.0, image["spacing"])  # a flat image may have spacing 0
    affine = np.eye(4)
    affine[:3, :3] = image["direction"] * steps
    affine[:3, 3] = image["origin"] + affine[:3, :3] @ (lower + np.where(of_cells, 0.5, 0.0))
    mask = image.get(f"{place}:mask")
    inside = None if mask is None else mask_in_file(f"{name}: mask", np.ascontiguousarray(_on_grid(mask, shape)))
    found = found._replace(tensors=_on_grid(found.tensors, shape), of=f" from {chosen!r} at the {place}s")
    volume = placed(name, found, frame or "world", affine, mask=inside, length_unit="")
    if np.array_equal(affine[:3, :3], np.diag(volume.spacing)):
        volume = replace(volume, affine=None, origin=tuple(affine[:3, 3].tolist()))
    else:
        note = "VTK does not name the axes of space; pictures take them as right, anterior and superior"
        volume = replace(volume, notes=(*volume.notes, note))
    return _as_plane(volume)


def _write(path: Path, array: np.ndarray, volume: TensorVolume, name: str, extra: dict[str, Any], record: str) -> None:
    _store(path, by_time(name, array, array.ndim - volume.dimension, extra), volume, record, extra)


def _write_tensors(path: Path, volume: TensorVolume, provenance: Mapping[str, Any] | None) -> None:
    """Write tensors along the axes of space; for a slice, the components across its plane are zero."""
    tensors = volume.tensors
    if volume.dimension == 2:
        tensors = np.insert(np.insert(tensors, volume.thin_axis, 0, axis=-1), volume.thin_axis, 0, axis=-2)
    rotation = nearest_rotation(volume.volume_affine[:3, :3]).astype(tensors.dtype)
    record = describe_tensors(volume, "matrix", "world", provenance)
    _store(path, {"tensors": rotation @ tensors @ rotation.T}, volume, record, {})


def by_time(name: str, array: np.ndarray, n: int, extra: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Return the array or, if it has an axis of times (n = 1), one array per time, by names that contain the time."""
    if n == 0:
        return {name: array}
    times = np.ravel(extra.get("times", ()))
    labels = [f"{name}_{i}" + (f"_t{times[i]:.6g}" if len(times) == len(array) else "") for i in range(len(array))]
    return dict(zip(labels, array, strict=True))


def _store(path: Path, arrays: dict[str, np.ndarray], volume: TensorVolume, record: str, more: dict[str, Any]) -> None:
    """Write the arrays and the mask as point data (matrices as tensors), and `more` and the record as field data."""
    optional("vtkmodules.vtkIOXML")
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonCore import vtkStringArray
    from vtkmodules.vtkCommonDataModel import vtkImageData
    from vtkmodules.vtkIOXML import vtkXMLImageDataWriter

    affine = volume.volume_affine
    spacing = np.linalg.norm(affine[:3, :3], axis=0)
    shape = volume.volume_shape
    image = vtkImageData()
    image.SetDimensions(*shape)
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
    for name, values in more.items():
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
            raise OSError(f"{path}: VTK could not write the file")


def _check_pieces(content: bytes) -> None:
    """Raise ValueError unless the pieces of an image fill its whole extent; VTK would not report missing values."""
    head = content.partition(b"<AppendedData")[0]

    def cells(extent: bytes) -> int:
        ends = [int(word) for word in extent.split()]
        steps = [high - low for low, high in zip(ends[::2], ends[1::2], strict=True)]
        return 0 if min(steps) < 0 else math.prod(max(n, 1) for n in steps)

    whole, there = (
        sum(map(cells, re.findall(rb"\b" + name + rb"\s*=\s*[\"']([^\"']*)", head)))
        for name in (b"WholeExtent", b"Extent")
    )
    if whole != there:
        raise ValueError(f"got pieces with {there} cells; expected the {whole} cells of the whole extent")


def _check_range(content: bytes, array: str, values: np.ndarray) -> None:
    """Raise ValueError unless the array's values, or the norms of its rows, have the range that the file declares."""
    tag = re.search(rb"<DataArray\b[^>]*\bName=\"" + re.escape(array.encode()) + rb"\"[^>]*>", content)
    told = [float(word) for word in re.findall(rb"\bRangeM(?:in|ax)=\"([^\"]+)\"", tag[0])] if tag else []
    if len(told) < 2 or np.isnan(values).any() or b"vtkGhostType" in content[:10_000]:  # the range omits ghost values
        return
    with np.errstate(over="ignore"):
        lengths = np.linalg.norm(values, axis=-1)
    if not any(np.allclose([each.min(), each.max()], told, rtol=1e-4) for each in (lengths, values)):
        raise ValueError(
            f"array {array!r} has rows with norms from {lengths.min():.4g} to {lengths.max():.4g}; expected "
            f"{told[0]:.4g} to {told[1]:.4g}, as the file declares"
        )


def _check_length(content: bytes, array: str, values: np.ndarray) -> None:
    """Raise ValueError if a legacy file ends before the end of an array, which VTK may not detect."""
    key = re.escape(quote(array).encode())
    line = re.search(rb"\n(?:(?:TENSORS6?|SCALARS) " + key + rb" \w+.*|" + key + rb" \d+ \d+ \w+.*)\n", content)
    if line is None:
        return  # the array is not found, because its name is written differently
    rest, text = content[line.end() :], b"ASCII" in content.split(maxsplit=40)[:40]
    if len(rest.split(maxsplit=values.size)) < values.size if text else len(rest) < values.nbytes:
        raise ValueError(f"the file ends before the end of the array {array!r}; expected {values.size} values")


def _tensor_array(image: Mapping[str, np.ndarray], wanted: str | None) -> tuple[str, str, bool]:
    """Return the place (point or cell) and name of the array to read, and whether the file declares it as tensors."""
    for place in ("point", "cell"):
        arrays = {key.partition(":")[2]: a for key, a in image.items() if key.startswith(f"{place}:")}
        tensors = [n for n, a in arrays.items() if a.ndim == 2 and a.shape[1] in (6, 9) and wanted in (None, n)]
        declared = str(image.get(f"{place}s declared", ""))
        if declared in tensors or len(tensors) == 1:
            chosen = declared if declared in tensors else tensors[0]
            return place, chosen, chosen == declared
        if tensors:
            break
    had = {key.partition(":")[2]: a.shape[1:] for key, a in image.items() if key.startswith(("point:", "cell:"))}
    listed = ", ".join(f"{key!r} ({n[0] if n else 1})" for key, n in had.items()) or "none"
    asked = "" if wanted is None else f" named {wanted!r}"
    raise UnsuitedError(
        f"got the arrays (components) {listed}; expected one array of 6 or 9 components{asked}. Pass "
        f"{argument('array')}, the name of the array to read"
    )


def _on_grid(values: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return values (n, …) as (*shape, …), where VTK's fastest axis becomes the first."""
    return np.moveaxis(values.reshape(*shape[::-1], *values.shape[1:]), (0, 1, 2), (2, 1, 0))


def _as_plane(volume: TensorVolume) -> TensorVolume:
    """Return an image one voxel thick as a slice, if all components of its tensors across the plane are zero."""
    size = np.abs(volume.tensors).max()
    rounding = 100 * np.finfo(volume.tensors.dtype).eps * size  # errors of the tensors' rotation to the voxel axes
    for axis in range(3):
        if volume.shape[axis] == 1 and size > 0 and np.abs(volume.tensors[..., axis, :]).max() <= rounding:
            plane = volume.slice(("x", "y", "z")[axis], 0)
            affine = volume.volume_affine if volume.origin[axis] else volume.affine
            return replace(plane, affine=affine, notes=(*volume.notes, "read as 2×2 tensors in the plane"))
    return volume


FORMAT = Format((".vti", ".vtk"), _read_tensors, ("array",), None, (".vti",), _write, _write_tensors, image=".vti")
