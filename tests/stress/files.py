"""Damaged files: whatever a reader returns must be what was written, unless nothing in the file could tell.

A check writes a file of a random kind and content, damages it (bits flipped, cut short, bytes inserted, left out or
zeroed, a number in its head replaced), and reads it by the library. It is

- refused by one error of the library, a plain ValueError that names the file. Errors of other libraries, and running
  out of memory for a size that only a damaged header claims, fail.
- right: the content is what was written, to the bit. Or it is not, but the damage lies where the format protects
  nothing, and what was read is what the damaged file says:
    - values stored as they are (.npy, .nii, raw .nrrd, binary .stl): they must be those bytes, decoded here by
      themselves, and all else as it was;
    - numbers and names in a head that is not compressed (spacings in .nii, .nrrd, .vti; a name in .vti, a type of the
      same size in .npy), and meshes, text or binary without checksum: as many values in the same shape;
    - .obj and the tables .bval, .bvec: anything, as they do not say how much they hold; .vtu whose data are not
      compressed, as meshio passes over what the types of its cells tell it to.
  Values so damaged that they are NaN or not positive definite must then be refused as a metric.
- told, where the content differs and a warning said so.

Everything else is silent, and fails. Files of which every byte that matters is under a checksum (.npz, .nii.gz,
results, checkpoints) have no place without protection; in .nrrd, .vti, .vtp, .vtu with compressed data it is the head
alone.

Readers run in this process, but for VTK's: one that crashes ends the run, and leaves a temporary folder whose name
has the seed.
"""

import contextlib
import importlib.util
import io
import math
import re
import tempfile
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import hks_jax as hj
from hks_jax.inverse import checkpoint
from hks_jax.inverse.metric_fit import Step
from hks_jax.io.dwi import _numbers
from hks_jax.io.result import Result

from .harness import Outcome

Content = dict[str, np.ndarray | None]


@dataclass(frozen=True)
class Sample:
    """A whole file.

    Attributes:
        path: where it is.
        read: reads it, or a damaged one.
        open: the bytes that nothing protects.
        values: of these, those that hold values as they are.
        decode: takes the bytes of `values` and returns what they stand for.
        loose: what damage in the other open bytes may change, but not in its shape.
        countless: whether the format does not say how much it holds.
    """

    path: Path
    read: Callable[[Path], Content]
    open: tuple[int, int] = (0, 0)
    values: tuple[int, int] = (0, 0)
    decode: Callable[[bytes], Content] | None = None
    loose: tuple[str, ...] = ()
    countless: bool = False


def check(seed: int) -> Outcome:
    """Write a file, damage it, read it; see above."""
    rng = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory(prefix=f"stress-files-{seed}-") as folder:
        maker = MAKERS[rng.integers(len(MAKERS))]
        sample = maker(rng, Path(folder))
        whole = sample.path.read_bytes()
        damaged = whole
        while damaged == whole:
            damaged = _damage(rng, whole)
        return _judge(sample, whole, damaged)


def _judge(sample: Sample, whole: bytes, damaged: bytes) -> Outcome:
    before = sample.read(sample.path)
    path = sample.path.with_name(f"damaged{''.join(sample.path.suffixes)}")
    path.write_bytes(damaged)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        after, error = _tried(sample.read, path)
    if error is not None:
        assert path.name in str(error), f"an error that does not name the file: {error}"
        believed = (".msh", ".vtk")  # whose sizes meshio allocates as they stand
        memory = isinstance(error.__cause__, MemoryError) and path.suffix not in believed
        assert not memory, f"allocated before it was checked: {error}"
        return "refused"
    different = [name for name in before if not _same(before[name], after[name])]
    if not different:
        return "right"
    what = f"{path.name}: {', '.join(different)} changed without a word, damaged at {_places(whole, damaged)}"
    if said:
        return "told"
    places = _places(whole, damaged)
    assert _within(places, sample.open), what
    if sample.countless:
        return "right"
    if sample.decode and len(whole) == len(damaged) and _within(places, sample.values):
        start, stop = sample.values
        expected = before | sample.decode(damaged[start:stop])
        wrong = [name for name in expected if not _same_numbers(expected[name], after[name])]
        assert not wrong, f"{path.name}: {', '.join(wrong)} are not what the bytes say"
    else:
        for name in different:
            assert name in sample.loose, what
            assert np.shape(after[name]) == np.shape(before[name]) or name in ("mask", "affine"), what
    _refused_as_metric(after)
    return "right"


def _tried(read: Callable[[Path], Content], path: Path) -> tuple[Content, ValueError | None]:
    """Return what is read, or the library's own error; every other one passes."""
    try:
        return read(path), None
    except ValueError as error:
        if type(error) is not ValueError:
            raise
        return {}, error


def _within(places: list[int], span: tuple[int, int]) -> bool:
    return span[0] <= places[0] <= places[-1] < span[1]


def _places(whole: bytes, damaged: bytes) -> list[int]:
    """Return where a file was damaged: each byte, or where bytes were put in or taken out, from where to where."""
    if len(whole) == len(damaged):
        return np.flatnonzero(np.frombuffer(whole, np.uint8) != np.frombuffer(damaged, np.uint8)).tolist()
    n = min(len(whole), len(damaged))
    a, b = np.frombuffer(whole, np.uint8), np.frombuffer(damaged, np.uint8)
    first = next(iter(np.flatnonzero(a[:n] != b[:n])), n)
    last = next(iter(np.flatnonzero(a[::-1][:n] != b[::-1][:n])), n)
    first = min(int(first), len(whole) - 1)
    return [first, max(first, len(whole) - int(last) - 1)]


def _same(a: Any, b: Any) -> bool:
    if a is None or b is None:
        return a is b
    a, b = np.asarray(a), np.asarray(b)
    return a.shape == b.shape and a.dtype == b.dtype and a.tobytes() == b.tobytes()


def _same_numbers(expected: Any, found: Any) -> bool:
    """Whether tensors, or numbers, are equal where finite, and not finite where not: axes mix their components."""
    if expected is None or found is None:
        return expected is found
    axes = tuple(range(np.ndim(expected)))[-2:] if np.shape(expected)[-1:] == np.shape(expected)[-2:-1] else ()
    finite = np.isfinite(expected).all(axes, keepdims=True)
    return np.array_equal(finite, np.isfinite(found).all(axes, keepdims=True)) and bool(
        np.where(finite, np.asarray(expected) == np.asarray(found), True).all()
    )


def _refused_as_metric(content: Content) -> None:
    tensors, mask = content.get("tensors"), content.get("mask")
    if tensors is None:
        return
    inside = np.ones(tensors.shape[:-2], bool) if mask is None else mask
    if np.isfinite(tensors[inside]).all():
        values = np.linalg.eigvalsh(tensors[inside].astype(np.float64))
        if (values[:, 0] > -1e-6 * values[:, -1]).all():  # rounding decides about those near zero
            return
    try:
        hj.TensorField(hj.Grid(inside.shape, mask=mask, components="all"), tensors)
    except ValueError:
        return
    raise AssertionError("tensors that are NaN or not positive definite were taken for a metric")


# Damage.


def _damage(rng: np.random.Generator, whole: bytes) -> bytes:
    content = bytearray(whole)
    here = int(rng.integers(len(content)))
    match rng.integers(8):
        case 0 | 1:
            content[here] ^= 1 << rng.integers(8)
        case 2:
            for place in rng.integers(len(content), size=rng.integers(2, 6)):
                content[place] ^= 1 << rng.integers(8)
        case 3:
            del content[len(content) - int(min(rng.integers(1, 200), len(content) * rng.random() + 1)) :]
        case 4:
            content[here:here] = rng.bytes(int(rng.integers(1, 17)))
        case 5:
            length = min(int(rng.integers(1, 65)), len(content) - here)
            content[here : here + length] = bytes(length)
        case 6:
            del content[here : here + int(rng.integers(1, 33))]
        case 7:
            _damage_head(rng, content)
    return bytes(content)


def _damage_head(rng: np.random.Generator, content: bytearray) -> None:
    """Put another number in place of one in the head, in text or in binary: a great one, a negative one, any."""
    numbers = list(re.finditer(rb"(?<![\w.])\d+(?![\w.])", bytes(content[:2000])))
    if numbers and rng.random() < 0.7:
        found = numbers[rng.integers(len(numbers))]
        new = [b"99999999999", b"2147483647", b"-1", b"0", b"nan", b"%d" % rng.integers(300)][rng.integers(6)]
        content[found.start() : found.end()] = new
    else:
        width = int(rng.choice([1, 2, 4, 8]))
        here = int(rng.integers(max(1, min(400, len(content)) - width)))
        new = [b"\xff" * width, b"\x7f" * width, bytes(width), rng.bytes(width)][rng.integers(4)]
        content[here : here + width] = new


# Files of tensors and of results.


def _tensors(rng: np.random.Generator, shape: tuple[int, ...], dtype: Any) -> np.ndarray:
    d = len(shape)
    factors = rng.standard_normal((*shape, d, d))
    return (np.eye(d) + factors @ np.swapaxes(factors, -1, -2)).astype(dtype)


def _volume(rng: np.random.Generator, d: int) -> hj.io.TensorVolume:
    shape = tuple(rng.integers(2, 6, d).tolist())
    tensors = _tensors(rng, shape, rng.choice([np.float32, np.float64]))
    spacing = tuple(np.round(rng.uniform(0.5, 3, d), 2).tolist())
    mask = rng.random(shape) < 0.9 if rng.random() < 0.5 else None
    affine = None
    if d == 3 and rng.random() < 0.5:
        affine = np.diag([*spacing, 1.0])
        affine[:3, 3] = np.round(rng.uniform(-9, 9, 3), 1)
    return hj.io.TensorVolume(tensors, spacing, (0.0,) * d, mask, affine)


def _of_volume(path: Path) -> Content:
    volume = hj.io.read_tensors(path)
    names = ("tensors", "spacing", "origin", "mask", "affine")
    return {name: None if (value := getattr(volume, name)) is None else np.asarray(value) for name in names}


_FREE = ("tensors", "spacing", "origin", "affine", "mask")


def _archive(rng: np.random.Generator, folder: Path) -> Sample:
    volume = _volume(rng, int(rng.integers(2, 4)))
    path = folder / "t.npz"
    if rng.random() < 0.5:
        hj.io.save_tensors(path, volume)
    else:
        np.savez(path, tensors=volume.tensors, spacing=volume.spacing)
    return Sample(path, _of_volume)


def _array(rng: np.random.Generator, folder: Path) -> Sample:
    tensors = _tensors(rng, (4, 3), rng.choice([np.float32, np.float64]))
    path = folder / "t.npy"
    np.save(path, tensors)
    size, start = path.stat().st_size, path.stat().st_size - tensors.nbytes

    def decode(content: bytes) -> Content:
        return {"tensors": np.frombuffer(content, tensors.dtype).reshape(tensors.shape)}

    return Sample(path, _of_volume, (0, size), (start, size), decode, _FREE)


def _nifti(rng: np.random.Generator, folder: Path, suffix: str = ".nii") -> Sample:
    volume = _volume(rng, 3)
    path = hj.io.save_tensors(folder / f"t{suffix}", volume)
    if suffix == ".nii.gz":
        return Sample(path, _of_volume)
    size, shape, dtype = path.stat().st_size, volume.shape, volume.tensors.dtype
    start = size - math.prod(shape) * 6 * dtype.itemsize

    def decode(content: bytes) -> Content:
        six = np.frombuffer(content, dtype).reshape(6, *shape[::-1]).T
        return {"tensors": six[..., [[0, 1, 3], [1, 2, 4], [3, 4, 5]]]}

    return Sample(path, _of_volume, (0, size), (start, size), decode, _FREE)


def _nifti_gz(rng: np.random.Generator, folder: Path) -> Sample:
    return _nifti(rng, folder, ".nii.gz")


def _mask(rng: np.random.Generator, folder: Path) -> Sample:
    import nibabel

    path = folder / "m.nii.gz"
    nibabel.save(nibabel.Nifti1Image(rng.integers(0, 2, (5, 4, 3)).astype(np.uint8), np.eye(4)), path)
    return Sample(path, lambda path: {"mask": hj.io.read_mask(path)})


def _nrrd(rng: np.random.Generator, folder: Path) -> Sample:
    path = hj.io.save_tensors(folder / "t.nrrd", _volume(rng, int(rng.integers(2, 4))))
    return Sample(path, _of_volume, (0, path.read_bytes().index(b"\n\n") + 1), loose=_FREE)


def _nrrd_raw(rng: np.random.Generator, folder: Path) -> Sample:
    import nrrd

    path, tensors = folder / "t.nrrd", _tensors(rng, (4, 3), np.float64)
    header = {"kinds": ["2D-matrix", "space", "space"], "space dimension": 2, "encoding": "raw"}
    header["space directions"] = np.array([[np.nan, np.nan], [1.5, 0], [0, 2.5]])
    nrrd.write(str(path), np.moveaxis(tensors.reshape(4, 3, 4), -1, 0), header)
    size = path.stat().st_size

    def decode(content: bytes) -> Content:
        return {"tensors": np.frombuffer(content, "<f8").reshape(3, 4, 2, 2).swapaxes(0, 1)}

    return Sample(path, _of_volume, (0, size), (size - tensors.nbytes, size), decode, _FREE)


def _vti(rng: np.random.Generator, folder: Path) -> Sample:
    path = hj.io.save_tensors(folder / "t.vti", _volume(rng, int(rng.integers(2, 4))))
    return Sample(path, _of_volume, (0, path.read_bytes().index(b"<AppendedData")), loose=_FREE)


def _result(rng: np.random.Generator, folder: Path) -> Sample:
    volume = _volume(rng, 2).with_mask(None)
    times = np.sort(rng.uniform(0.1, 9, 3))
    values = rng.random((3, *volume.shape))
    path = hj.io.save(folder / "hks.npz", values, volume, name="hks", extra={"times": times})

    def read(path: Path) -> Content:
        saved = Result.read(path)
        return {
            "values": saved.values,
            "times": saved.times,
            "mask": saved.grid.mask,
            "place": np.array(saved.grid.extent),
        }

    return Sample(path, read)


def _checkpoint(rng: np.random.Generator, folder: Path) -> Sample:
    steps = [Step(i, *rng.random(3).tolist(), True, 1.0, 0, 0) for i in range(int(rng.integers(1, 4)))]
    values = rng.random((3, 20))
    path = folder / "fit.npz"
    checkpoint.save(path, "mark", checkpoint.Checkpoint(values, steps, 1, 0, 0.5, 2 * values, [0.5]))

    def read(path: Path) -> Content:
        found = checkpoint.load(path, "mark")
        return {"history": np.array([tuple(vars(step).values()) for step in found.history])} | {
            name: np.asarray(value) for name, value in vars(found).items() if name != "history"
        }

    return Sample(path, read)


def _table(rng: np.random.Generator, folder: Path) -> Sample:
    path = folder / "t.bvec"
    np.savetxt(path, rng.standard_normal((3, 7)), "%.6f")
    size = path.stat().st_size
    return Sample(path, lambda path: {"numbers": _numbers(path)}, (0, size), countless=True)


# Meshes.


def _surface(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A wavy grid of triangles."""
    n, m = rng.integers(3, 6, 2).tolist()
    x, y = np.meshgrid(np.arange(n), np.arange(m), indexing="ij")
    vertices = np.stack([x, y, 0.1 * rng.standard_normal((n, m))], -1).reshape(-1, 3)
    vertices[:, :2] += 0.1 * rng.random((n * m, 2))
    a = (np.arange(n - 1)[:, None] * m + np.arange(m - 1)).ravel()
    return vertices, np.concatenate([np.stack([a, a + m, a + 1], -1), np.stack([a + m, a + m + 1, a + 1], -1)])


def _of_mesh(path: Path) -> Content:
    mesh = hj.io.read_mesh(path)
    return {"vertices": np.asarray(mesh.vertices), "cells": mesh.triangulation.cells}


def _of_corners(path: Path) -> Content:
    """Of .stl, which has no vertices: those that `read_mesh` makes of corners at one place are not in the file."""
    mesh = hj.io.read_mesh(path)
    return {"corners": np.asarray(mesh.vertices)[mesh.faces]}


def _facets(content: bytes) -> Content:
    facets = np.frombuffer(content[84:], [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attributes", "<u2")])
    return {"corners": facets["corners"].astype(np.float64)}


def _mesh(rng: np.random.Generator, folder: Path) -> Sample:
    import meshio

    vertices, faces = _surface(rng)
    suffix, options = _MESHES[rng.integers(len(_MESHES))]
    path = folder / f"m.{suffix}"
    mesh = meshio.Mesh(vertices, [("triangle", faces.astype(np.int32))])
    if suffix != "off" and suffix != "stl" and suffix != "obj" and rng.random() < 0.5:
        mesh.point_data["hks"] = rng.random(len(vertices))
    getattr(meshio, suffix).write(str(path), mesh, **options)
    size = path.stat().st_size
    if suffix == "stl":
        if not options["binary"]:
            return Sample(path, _of_corners, (0, size), loose=("corners",))
        return Sample(path, _of_corners, (0, size), (0, size), _facets)
    if suffix == "vtu" and options["compression"]:
        return Sample(path, _of_mesh)
    return Sample(path, _of_mesh, (0, size), loose=("vertices", "cells"), countless=suffix in ("obj", "vtu"))


def _solid(rng: np.random.Generator, folder: Path) -> Sample:
    """Tetrahedra, which Gmsh's files hold as text or binary."""
    import meshio

    ball = hj.examples.ball_mesh(int(rng.integers(1, 3)))
    places = np.asarray(ball.vertices) + 0.02 * rng.standard_normal(ball.vertices.shape)
    mesh = meshio.Mesh(places, [("tetra", ball.cells.astype(np.int32))])
    kind, options = _SOLIDS[rng.integers(len(_SOLIDS))]
    path = folder / f"s.{'msh' if kind == 'gmsh' else kind}"
    with contextlib.redirect_stderr(io.StringIO()):  # where it says that it adds what format 2.2 asks for
        getattr(meshio, kind).write(str(path), mesh, **options)
    return Sample(path, _of_mesh, (0, path.stat().st_size), loose=("vertices", "cells"), countless=kind == "vtu")


_SOLIDS: list[tuple[str, dict[str, Any]]] = [
    *(("gmsh", {"fmt_version": version, "binary": binary}) for version in ("2.2", "4.1") for binary in (True, False)),
    ("vtk", {"binary": True, "fmt_version": "5.1"}),
    ("vtu", {"binary": True, "compression": None}),
]


def _cortex(rng: np.random.Generator, folder: Path) -> Sample:
    """GIFTI, text or base64, and FreeSurfer's triangles."""
    import nibabel

    vertices, faces = _surface(rng)
    encoding = rng.choice(["", "GIFTI_ENCODING_ASCII", "GIFTI_ENCODING_B64BIN", "GIFTI_ENCODING_B64GZ"])
    path = folder / ("lh.surf.gii" if encoding else "lh.white")
    if encoding:
        kinds = ((vertices.astype(np.float32), "POINTSET"), (faces.astype(np.int32), "TRIANGLE"))
        arrays = [nibabel.gifti.GiftiDataArray(x, f"NIFTI_INTENT_{kind}", encoding=encoding) for x, kind in kinds]
        nibabel.save(nibabel.gifti.GiftiImage(darrays=arrays), path)
    else:
        nibabel.freesurfer.write_geometry(path, vertices, faces, create_stamp="made for a test")
    return Sample(path, _of_mesh, (0, path.stat().st_size), loose=("vertices", "cells"))


_MESHES: list[tuple[str, dict[str, Any]]] = [
    ("off", {}),
    ("obj", {}),
    ("stl", {"binary": True}),
    ("stl", {"binary": False}),
    ("ply", {"binary": True}),
    ("ply", {"binary": False}),
    ("vtk", {"binary": True, "fmt_version": "4.2"}),
    ("vtk", {"binary": False, "fmt_version": "4.2"}),
    ("vtk", {"binary": True, "fmt_version": "5.1"}),
    ("vtk", {"binary": False, "fmt_version": "5.1"}),
    ("vtu", {"binary": True, "compression": "zlib"}),
    ("vtu", {"binary": True, "compression": None}),
    ("vtu", {"binary": False, "compression": None}),
]


def _polygons(rng: np.random.Generator, folder: Path) -> Sample:
    from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData
    from vtkmodules.vtkIOLegacy import vtkPolyDataWriter
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

    vertices, faces = _surface(rng)
    points, cells, data = vtkPoints(), vtkCellArray(), vtkPolyData()
    points.SetData(numpy_to_vtk(vertices, deep=True))
    for_vtk = partial(numpy_to_vtkIdTypeArray, deep=True)
    cells.SetData(for_vtk(np.arange(0, faces.size + 1, 3)), for_vtk(faces.ravel().astype(np.int64)))
    data.SetPoints(points)
    data.SetPolys(cells)
    xml, binary = bool(rng.integers(2)), bool(rng.integers(2))
    path = folder / ("p.vtp" if xml else "p.vtk")
    writer = vtkXMLPolyDataWriter() if xml else vtkPolyDataWriter()
    if not xml:
        writer.SetFileVersion(int(rng.choice([42, 51])))
        if binary:
            writer.SetFileTypeToBinary()
    writer.SetFileName(str(path))
    writer.SetInputData(data)
    writer.Write()
    content = path.read_bytes()
    stop = content.index(b"<AppendedData") if xml else len(content)
    return Sample(path, _of_mesh, (0, stop), loose=("vertices", "cells"))


MAKERS = [
    _archive,
    _array,
    _nifti,
    _nifti_gz,
    _mask,
    _nrrd,
    _nrrd_raw,
    _result,
    _checkpoint,
    _table,
    _mesh,
    _mesh,
    _mesh,
    _solid,
    _cortex,
]
if importlib.util.find_spec("vtkmodules"):
    from vtkmodules.vtkCommonCore import vtkObject

    vtkObject.GlobalWarningDisplayOff()
    MAKERS += [_vti, _vti, _polygons]
