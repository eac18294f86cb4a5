"""VTK image data: files that VTK wrote, against what VTK reads and where it puts the points."""

import json
import re

import numpy as np
import pytest

import hks_jax as hj
from hks_jax.io import TensorVolume, read_tensors, save, save_tensors

pytest.importorskip("vtkmodules", reason='VTK is not installed: pip install "hks-jax[vtk]"')

from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy
from vtkmodules.vtkCommonDataModel import vtkImageData
from vtkmodules.vtkIOLegacy import vtkPolyDataWriter, vtkStructuredPointsWriter
from vtkmodules.vtkIOXML import vtkXMLImageDataReader, vtkXMLImageDataWriter

SHAPE = (4, 5, 6)
SPACING = np.array([1.5, 2.0, 3.25])
A, B = 0.3, -0.7
AXES = np.array([[np.cos(A), -np.sin(A), 0], [np.sin(A), np.cos(A), 0], [0, 0, 1]]) @ np.array(
    [[-1, 0, 0], [0, np.cos(B), -np.sin(B)], [0, np.sin(B), np.cos(B)]]
)


@pytest.fixture
def tensors():
    root = np.random.default_rng(3).normal(size=(*SHAPE, 3, 3))
    return root @ np.swapaxes(root, -1, -2) + np.eye(3)


def image(shape=SHAPE, axes=AXES, origin=(11.0, -7.0, 3.0)):
    data = vtkImageData()
    data.SetExtent(*[end for n in shape for end in (0, n - 1)])
    data.SetSpacing(*SPACING)
    data.SetOrigin(*origin)
    data.SetDirectionMatrix(*axes.ravel())
    return data


def add(attributes, name, values, declared=True):
    """Add values (nx, ny, nz, n), the first axis running fastest, as the tensors or merely as an array."""
    array = numpy_to_vtk(np.ascontiguousarray(values.transpose(2, 1, 0, 3).reshape(-1, values.shape[-1])), deep=True)
    array.SetName(name)
    attributes.SetTensors(array) if declared else attributes.AddArray(array)


def write(path, data, binary=True):
    if path.suffix == ".vti":
        writer = vtkXMLImageDataWriter()
        writer.SetDataModeToAppended() if binary else writer.SetDataModeToAscii()
    else:
        writer = vtkStructuredPointsWriter()
        writer.SetFileTypeToBinary() if binary else writer.SetFileTypeToASCII()
    writer.SetFileName(str(path))
    writer.SetInputData(data)
    assert writer.Write()
    return path


def six(tensors):
    return np.stack([tensors[..., i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))], -1)


@pytest.mark.parametrize("count", [6, 9])
@pytest.mark.parametrize("binary", [True, False])
def test_rotated_and_flipped_axes(tmp_path, tensors, count, binary):
    world = AXES @ tensors @ AXES.T
    data = image()
    add(data.GetPointData(), "D", six(world) if count == 6 else world.reshape(*SHAPE, 9))
    read = read_tensors(write(tmp_path / "t.vti", data, binary))
    np.testing.assert_allclose(read.tensors, tensors, rtol=1e-9, atol=1e-9)
    assert (read.order, read.frame) == ("vtk" if count == 6 else "matrix", "world")
    np.testing.assert_allclose(read.spacing, SPACING)
    for index in ((0, 0, 0), (3, 1, 2)):
        point = [0.0] * 3
        data.TransformIndexToPhysicalPoint(index, point)
        np.testing.assert_allclose((read.affine @ [*index, 1])[:3], point)
    assert "right, anterior and superior" in read.notes[-1]


@pytest.mark.parametrize("count", [6, 9])
@pytest.mark.parametrize("binary", [True, False])
def test_legacy_structured_points(tmp_path, tensors, count, binary):
    data = image(axes=np.eye(3))
    add(data.GetPointData(), "D", six(tensors) if count == 6 else tensors.reshape(*SHAPE, 9))
    read = read_tensors(write(tmp_path / "t.vtk", data, binary))
    np.testing.assert_allclose(read.tensors, tensors, rtol=1e-9)
    assert (read.affine, read.spacing, read.origin) == (None, tuple(SPACING), (11.0, -7.0, 3.0))


def test_an_extent_that_does_not_start_at_zero_and_cells(tmp_path, tensors):
    data = image()
    data.SetExtent(2, 5, -1, 3, 7, 12)
    add(data.GetPointData(), "D", (AXES @ tensors @ AXES.T).reshape(*SHAPE, 9))
    read = read_tensors(write(tmp_path / "t.vti", data))
    np.testing.assert_allclose(read.affine[:3, 3], data.GetPoint(0))
    np.testing.assert_allclose((read.affine @ [3, 4, 5, 1])[:3], data.GetPoint(data.GetNumberOfPoints() - 1))

    cells = image(shape=tuple(n + 1 for n in SHAPE))
    add(cells.GetCellData(), "D", (AXES @ tensors @ AXES.T).reshape(*SHAPE, 9))
    read = read_tensors(write(tmp_path / "t.vti", cells))
    np.testing.assert_allclose(read.tensors, tensors, rtol=1e-9, atol=1e-9)
    bounds = np.array(cells.GetCell(0).GetBounds()).reshape(3, 2)
    corners = [cells.GetCell(0).GetPoints().GetPoint(i) for i in range(8)]
    assert (bounds[:, 0] < read.affine[:3, 3]).all()
    np.testing.assert_allclose(read.affine[:3, 3], np.mean(corners, 0))


def test_what_is_left_open_is_refused(tmp_path, tensors):
    data = image(axes=np.eye(3))
    add(data.GetPointData(), "D", six(tensors), declared=False)
    path = write(tmp_path / "t.vti", data)
    with pytest.raises(ValueError, match=r'does not declare their order.*"vtk" \(xx yy zz xy yz xz\)'):
        read_tensors(path)
    np.testing.assert_allclose(read_tensors(path, "vtk").tensors, tensors)
    add(data.GetPointData(), "E", 2 * six(tensors), declared=False)
    write(path, data)
    with pytest.raises(ValueError, match=r"got the arrays \(components\) 'D' \(6\), 'E' \(6\); .* Pass array"):
        read_tensors(path, "vtk")
    np.testing.assert_allclose(read_tensors(path, "vtk", array="E").tensors, 2 * tensors)
    with pytest.raises(ValueError, match="named 'F'"):
        read_tensors(path, "vtk", array="F")
    with pytest.raises(ValueError, match="only npz and VTK files have named arrays"):
        read_tensors("t.nii", array="F")


def test_damaged_files(tmp_path, tensors):
    data = image(axes=np.eye(3))
    add(data.GetPointData(), "D", tensors.reshape(*SHAPE, 9))
    for name, binary in (("a.vti", False), ("b.vti", True), ("a.vtk", False), ("b.vtk", True)):
        path = write(tmp_path / name, data, binary)
        path.write_bytes(path.read_bytes()[:-500])
        with pytest.raises(ValueError, match="damaged or not readable VTK image data"):
            read_tensors(path)
        path.write_bytes(b"not what the name says")
        with pytest.raises(ValueError, match="damaged or not readable VTK image data"):
            read_tensors(path)
    writer = vtkPolyDataWriter()
    from vtkmodules.vtkCommonDataModel import vtkPolyData

    writer.SetInputData(vtkPolyData())
    writer.SetFileName(str(tmp_path / "mesh.vtk"))
    assert writer.Write()
    with pytest.raises(ValueError, match="structured points"):
        read_tensors(tmp_path / "mesh.vtk")


# ---------------------------------------------------------------------------------------------------- writing


@pytest.fixture
def volume(tensors):
    mask = np.ones(SHAPE, bool)
    mask[0] = False
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = AXES * SPACING, (11.0, -7.0, 3.0)
    return TensorVolume(tensors, tuple(SPACING), (0.0,) * 3, mask, affine)


def load(path):
    reader = vtkXMLImageDataReader()
    reader.SetFileName(str(path))
    reader.Update()
    return reader.GetOutput()


def test_written_tensors_are_what_vtk_and_we_read(tmp_path, volume):
    path = save_tensors(tmp_path / "t.vti", volume)
    data = load(path)
    point = data.FindPoint((volume.affine @ [1, 2, 3, 1])[:3])
    world = AXES @ volume.tensors[1, 2, 3] @ AXES.T
    np.testing.assert_allclose(np.reshape(data.GetPointData().GetTensors().GetTuple(point), (3, 3)), world)
    read = read_tensors(path)
    np.testing.assert_allclose(read.tensors, volume.tensors, rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(read.mask, volume.mask)
    np.testing.assert_allclose(read.affine, volume.affine, atol=1e-12)


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_slices_round_trip(tmp_path, volume, axis):
    plane = volume.slice(axis, 2)
    read = read_tensors(save_tensors(tmp_path / "t.vti", plane))
    np.testing.assert_allclose(read.tensors, plane.tensors, rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(read.mask, plane.mask)
    np.testing.assert_allclose(read.affine, plane.affine, atol=1e-12)
    assert read.slice_axis == "xyz".index(axis)
    flat = TensorVolume(plane.tensors, (0.5, 2.0), (10.0, 20.0))
    read = read_tensors(save_tensors(tmp_path / "t.vti", flat))
    assert (read.affine, read.spacing, read.origin) == (None, flat.spacing, flat.origin)


def test_results_with_their_times(tmp_path, volume):
    values = np.random.default_rng(0).random((2, *SHAPE))
    values[:, ~volume.mask] = np.nan
    path = save(tmp_path / "v.vti", values, volume, name="hks", extra={"times": [0.5, 2.0]}, provenance={"k": 7})
    data = load(path)
    arrays = data.GetPointData()
    assert [arrays.GetArrayName(i) for i in range(3)] == ["hks_0_t0.5", "hks_1_t2", "mask"]
    point = data.FindPoint((volume.affine @ [3, 1, 2, 1])[:3])
    assert arrays.GetArray("hks_1_t2").GetTuple1(point) == values[1, 3, 1, 2]
    np.testing.assert_array_equal(vtk_to_numpy(data.GetFieldData().GetArray("times")), [0.5, 2])
    record = json.loads(data.GetFieldData().GetAbstractArray("provenance").GetValue(0))
    assert (record["k"], record["software"]) == (7, f"hks-jax {hj.__version__}")
    with pytest.raises(ValueError, match=r"kind of file is unknown; expected .*\.vti"):
        save(tmp_path / "v.vtk", values, volume)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (r'"0 3 0 4 0 5"', '"0 3999 0 4999 0 99999"', "VTK crashed"),  # it aborts for want of memory
        (r'WholeExtent="0 3', 'WholeExtent="0 99999999', "got pieces with 60 cells; expected the"),
        (r'WholeExtent="0 3', 'WholeExtent="-1 3', "got pieces with 60 cells; expected the 80 cells of"),
        (r'Direction="', 'Direction="7', "expected orthonormal columns"),
        (r'NumberOfTuples="1"', 'NumberOfTuples="99999999999"', ""),
        (r'NumberOfComponents="9"', 'NumberOfComponents="6"', "'tensors' has rows with norms"),
        (r'type="Float64"', 'type="Float32"', "'tensors' has rows with norms"),
        (r'"vtkZLibDataCompressor"', '"vtkNoDataCompressor"', ""),
        (r"_\w{12}", "_////////AAAA", ""),
    ],
)
def test_a_vti_that_declares_what_it_does_not_hold(tmp_path, tensors, old, new, message):
    path = save_tensors(tmp_path / "t.vti", TensorVolume(tensors, tuple(SPACING), (0.0,) * 3))
    content, n = re.subn(old.encode(), new.encode(), path.read_bytes())
    assert n
    path.write_bytes(content)
    with pytest.raises(ValueError, match=rf"t\.vti: the file is damaged or not readable VTK image data.*{message}"):
        read_tensors(path)


def test_flipped_bits_in_compressed_vti_change_nothing_silently(tmp_path, tensors):
    rng = np.random.default_rng(5)
    path = save_tensors(tmp_path / "t.vti", TensorVolume(tensors, tuple(SPACING), (0.0,) * 3))
    whole = path.read_bytes()
    start, stop = whole.index(b"<AppendedData"), whole.index(b"</AppendedData>")
    before, refused = read_tensors(path), 0
    for place in rng.integers(start, stop, 12):
        content = bytearray(whole)
        content[place] ^= 1 << rng.integers(8)
        path.write_bytes(content)
        try:
            np.testing.assert_array_equal(read_tensors(path).tensors, before.tensors)
        except ValueError:
            refused += 1
    assert refused > 9


def legacy_surface(path, version, binary):
    from vtkmodules.vtkFiltersSources import vtkSphereSource

    sphere = vtkSphereSource()
    sphere.Update()
    writer = vtkPolyDataWriter()
    writer.SetFileVersion(version)
    writer.SetFileTypeToBinary() if binary else writer.SetFileTypeToASCII()
    writer.SetFileName(str(path))
    writer.SetInputData(sphere.GetOutput())
    assert writer.Write()
    return path.read_bytes()


@pytest.mark.parametrize(
    ("version", "binary", "old", "new"),
    [
        (51, True, b"POLYGONS 97", b"POLYGONS -1"),  # all of these VTK follows into memory that is not its own
        (51, False, b"POLYGONS 97", b"POLYGONS 9999999999"),
        (51, True, b"Version 5.1", b"Version(5.1"),
        (51, False, b"0 3 6", b"0 99 6"),
        (42, True, b"\x00\x00\x00\x03", b"\x00\x00\x70\x03"),
        (42, False, b"\n3 2 8", b"\n9 2 8"),
        (51, False, b"\n2 8 0", b"\n2 8888 0"),
    ],
)
def test_polygons_that_lead_astray(tmp_path, version, binary, old, new):
    path = tmp_path / "s.vtk"
    content = legacy_surface(path, version, binary)
    assert len(hj.io.read_mesh(path).faces) == 96
    assert old in content
    path.write_bytes(content.replace(old, new, 1))
    with pytest.raises(ValueError, match=r"s\.vtk: the file is damaged or not readable polygonal data"):
        hj.io.read_mesh(path)


def test_a_series_on_a_grid_has_an_image_for_each_time(tmp_path):
    place = TensorVolume(np.tile(np.eye(3), (4, 3, 2, 1, 1)), (1.0, 2.0, 3.0), (5.0, 0.0, 0.0))
    values = np.arange(48.0).reshape(2, 4, 3, 2)
    path = save(tmp_path / "u.pvd", values, place, name="u", extra={"times": [0.25, 3]})
    assert path.read_text(encoding="utf-8").count("<DataSet") == 2
    for i in range(2):
        reader = vtkXMLImageDataReader()
        reader.SetFileName(str(tmp_path / f"u.{i}.vti"))
        reader.Update()
        found = vtk_to_numpy(reader.GetOutput().GetPointData().GetArray("u"))
        np.testing.assert_array_equal(found.reshape(2, 3, 4).transpose(2, 1, 0), values[i])
