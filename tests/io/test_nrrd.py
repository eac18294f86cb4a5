"""NRRD: files that pynrrd wrote, against what pynrrd reads and the format's definition of axes."""

import json

import nibabel as nib
import numpy as np
import pytest

import hks_jax as hj
from hks_jax.io import TensorVolume, read_mask, read_tensors, save, save_tensors
from hks_jax.io.masks import read_labels
from hks_jax.io.nrrd import KINDS

nrrd = pytest.importorskip("nrrd")

SHAPE = (4, 5, 6)
LPS = np.diag([-1.0, -1.0, 1.0])
NONE = np.full((1, 3), np.nan)


def rotation(a, b):
    rz = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    rx = np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
    return rz @ rx


AXES = rotation(0.3, -0.7) @ np.diag([-1.0, 1.0, 1.0])  # the first voxel axis flipped; right, anterior, superior
SPACING = np.array([1.5, 2.0, 3.25])
ORIGIN = np.array([11.0, -7.0, 3.0])


def spd(shape, d):
    root = np.random.default_rng(3).normal(size=(*shape, d, d))
    return 1e-3 * (root @ np.swapaxes(root, -1, -2) + np.eye(d))


@pytest.fixture
def tensors():
    return spd(SHAPE, 3)


def components(tensors):
    """Return xx xy xz yy yz zz, or xx xy yy: the upper triangle by rows, as the format lists it."""
    i, j = np.triu_indices(tensors.shape[-1])
    return tensors[..., i, j]


def write(path, data, kind, axis=0, **header):
    """Write components (*shape, n) with their axis moved to `axis`."""
    kinds = ["space"] * (data.ndim - 1)
    kinds.insert(axis, kind)
    nrrd.write(str(path), np.moveaxis(data, -1, axis), {"kinds": kinds, **header}, index_order="F")
    return path


def placed(axis=0, directions=AXES * SPACING, space="right-anterior-superior"):
    return {"space": space, "space directions": np.insert(directions.T, axis, NONE, 0), "space origin": ORIGIN}


# ---------------------------------------------------------------------------------------------------- kinds


@pytest.mark.parametrize("kind", sorted(KINDS))
@pytest.mark.parametrize("last", [False, True])
def test_every_kind_at_any_axis(tmp_path, kind, last):
    d, masked, symmetric = int(kind[0]), "masked" in kind, "symmetric" in kind
    shape = SHAPE[:d]
    truth = spd(shape, d)
    data = components(truth) if symmetric else truth.reshape(*shape, d * d)
    inside = np.random.default_rng(0).random(shape) > 0.3
    if masked:
        data = np.concatenate([np.where(inside, 1.0, 0.2)[..., None], data], -1)
    read = read_tensors(write(tmp_path / "t.nrrd", data, kind, d if last else 0))
    np.testing.assert_array_equal(read.tensors, truth)
    if masked:
        np.testing.assert_array_equal(read.mask, inside)
        assert read_tensors(tmp_path / "t.nrrd", confidence=0.1).mask.all()
    else:
        assert read.mask is None
    assert (read.order, read.frame) == ("nrrd" if symmetric else "matrix", "voxel")
    assert any(kind in note for note in read.notes)


def test_teems_component_order(tmp_path):
    """The order of the format's definition, written out."""
    data = np.broadcast_to(np.array([1.0, 11, 12, 13, 22, 23, 33]), (*SHAPE, 7))
    read = read_tensors(write(tmp_path / "t.nrrd", data, "3D-masked-symmetric-matrix"))
    np.testing.assert_array_equal(read.tensors[1, 2, 3], [[11, 12, 13], [12, 22, 23], [13, 23, 33]])


# ---------------------------------------------------------------------------------------------------- space


@pytest.mark.parametrize("encoding", ["raw", "gzip", "ascii"])
@pytest.mark.parametrize(
    ("space", "signs"),
    [
        ("right-anterior-superior", (1, 1, 1)),
        ("RAS", (1, 1, 1)),
        ("left-posterior-superior", (-1, -1, 1)),
        ("left-anterior-superior", (-1, 1, 1)),
    ],
)
def test_rotated_axes_flip_space_and_measurement_frame(tmp_path, tensors, space, signs, encoding):
    to_ras = np.diag(signs).astype(float)
    frame = rotation(1.1, 0.4) @ np.diag([1.0, -1.0, 1.0])
    ras = AXES @ tensors @ AXES.T  # the tensors as seen by the scanner
    measured = frame.T @ (to_ras @ ras @ to_ras) @ frame  # D_space = M D M^T, the columns of M being the file's vectors
    header = placed(directions=to_ras @ AXES * SPACING, space=space) | {"space origin": to_ras @ ORIGIN}
    header |= {"measurement frame": frame.T, "encoding": encoding}
    path = write(tmp_path / "t.nrrd", components(measured), "3D-symmetric-matrix", **header)

    data, read_header = nrrd.read(str(path), index_order="F")
    np.testing.assert_allclose(data[1], measured[..., 0, 1], rtol=1e-12)
    np.testing.assert_allclose(read_header["measurement frame"][0], frame[:, 0])  # its first vector: a column
    read = read_tensors(path)
    np.testing.assert_allclose(read.tensors, tensors, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(read.affine, nib.affines.from_matvec(AXES * SPACING, ORIGIN))
    np.testing.assert_allclose(read.spacing, SPACING)
    assert read.frame == "measurement"


def test_a_measurement_frame_that_scales_does_so(tmp_path, tensors):
    header = placed(directions=np.diag(SPACING)) | {"measurement frame": 2 * np.eye(3)}
    read = read_tensors(write(tmp_path / "t.nrrd", components(tensors), "3D-symmetric-matrix", **header))
    np.testing.assert_allclose(read.tensors, 4 * tensors)
    assert any("not orthonormal" in note for note in read.notes)


def test_axes_that_no_measurement_frame_settles_are_refused(tmp_path, tensors):
    path = write(tmp_path / "t.nrrd", components(tensors), "3D-symmetric-matrix", **placed())
    with pytest.raises(ValueError, match=r'Pass frame="world".*or frame="voxel"'):
        read_tensors(path)
    with pytest.raises(ValueError, match="no measurement frame"):
        read_tensors(path, frame="measurement")
    np.testing.assert_allclose(read_tensors(path, frame="voxel").tensors, tensors)
    np.testing.assert_allclose(read_tensors(path, frame="world").tensors, AXES.T @ tensors @ AXES)
    # Along the axes of space, or all against them, both readings agree.
    for sign in (1, -1):
        header = placed(directions=sign * np.diag(SPACING))
        path = write(tmp_path / "t.nrrd", components(tensors), "3D-symmetric-matrix", **header)
        np.testing.assert_allclose(read_tensors(path).tensors, tensors)


def test_an_unnamed_space_gives_spacing_and_origin(tmp_path, tensors):
    header = placed(directions=np.diag(SPACING))
    del header["space"]
    read = read_tensors(write(tmp_path / "t.nrrd", components(tensors), "3D-symmetric-matrix", **header))
    assert (read.affine, read.spacing, read.origin) == (None, tuple(SPACING), tuple(ORIGIN))
    header = {"spacings": [np.nan, *SPACING]}
    read = read_tensors(write(tmp_path / "t.nrrd", components(tensors), "3D-symmetric-matrix", **header))
    assert (read.affine, read.spacing) == (None, tuple(SPACING))


# ---------------------------------------------------------------------------------------------------- what is refused


def test_components_of_no_kind_need_an_order(tmp_path, tensors):
    path = write(tmp_path / "t.nrrd", components(tensors), "list", axis=3)
    with pytest.raises(ValueError, match="does not declare their order") as caught:
        read_tensors(path)
    assert '"fsl" (xx xy xz yy yz zz)' in str(caught.value)
    np.testing.assert_array_equal(read_tensors(path, "fsl", frame="voxel").tensors, tensors)


def test_what_is_no_field_of_tensors_is_refused(tmp_path, tensors):
    nrrd.write(str(tmp_path / "t.nrrd"), tensors[..., 0, 0])
    with pytest.raises(ValueError, match=r"expected one axis of components.*3D-masked-symmetric-matrix"):
        read_tensors(tmp_path / "t.nrrd")
    write(tmp_path / "t.nrrd", components(tensors), "3D-masked-symmetric-matrix")
    with pytest.raises(ValueError, match="of 6 components; expected 7"):
        read_tensors(tmp_path / "t.nrrd")
    write(tmp_path / "t.nrrd", components(tensors)[:, :, 0], "3D-symmetric-matrix")
    with pytest.raises(ValueError, match="3×3 tensors on 2 axes"):
        read_tensors(tmp_path / "t.nrrd")
    write(tmp_path / "t.nrrd", tensors.reshape(*SHAPE, 9), "3D-matrix")
    with pytest.raises(ValueError, match="holds whole matrices"):
        read_tensors(tmp_path / "t.nrrd", "fsl")
    write(tmp_path / "t.nrrd", components(tensors), "3D-symmetric-matrix", **placed(directions=np.zeros((3, 3))))
    with pytest.raises(ValueError, match="nonzero vectors"):
        read_tensors(tmp_path / "t.nrrd")


def test_damaged_files(tmp_path, tensors):
    path = write(tmp_path / "t.nrrd", components(tensors), "3D-symmetric-matrix")
    (tmp_path / "cut.nrrd").write_bytes(path.read_bytes()[:-400])
    (tmp_path / "no.nrrd").write_bytes(b"not what the name says")
    for name in ("cut.nrrd", "no.nrrd"):
        with pytest.raises(ValueError, match="the file is damaged or not a readable NRRD file"):
            read_tensors(tmp_path / name)
    with pytest.raises(FileNotFoundError, match="no such file"):
        read_tensors(tmp_path / "absent.nrrd")


# ---------------------------------------------------------------------------------------------------- writing


@pytest.fixture
def volume(tensors):
    mask = np.ones(SHAPE, bool)
    mask[0] = False
    affine = nib.affines.from_matvec(AXES * SPACING, ORIGIN)
    return TensorVolume(tensors, tuple(SPACING), (0.0,) * 3, mask, affine, source="scan.nii.gz", digest="abc")


def test_written_tensors_are_what_pynrrd_and_we_read(tmp_path, volume):
    path = save_tensors(tmp_path / "t.nrrd", volume, provenance={"call": "a \"quoted\" 'word', λ"})
    data, header = nrrd.read(str(path), index_order="F")
    assert header["kinds"] == ["3D-masked-symmetric-matrix", "space", "space", "space"]
    np.testing.assert_array_equal(data[0], volume.mask)
    np.testing.assert_allclose(header["space directions"][1:].T, AXES * SPACING)
    matrix = header["measurement frame"].T
    d = np.zeros((3, 3))
    d[np.triu_indices(3)] = data[1:, 1, 2, 3]
    world = matrix @ (d + np.triu(d, 1).T) @ matrix.T
    np.testing.assert_allclose(world, AXES @ volume.tensors[1, 2, 3] @ AXES.T, rtol=1e-12)
    record = json.loads(header["provenance"])
    assert (record["source"], record["sha256"], record["call"]) == ("scan.nii.gz", "abc", "a \"quoted\" 'word', λ")
    assert record["software"] == f"hks-jax {hj.__version__}"

    read = read_tensors(path)
    np.testing.assert_allclose(read.tensors, volume.tensors, rtol=1e-12, atol=1e-18)
    np.testing.assert_array_equal(read.mask, volume.mask)
    np.testing.assert_allclose(read.affine, volume.affine)


def test_a_plane_field_round_trip(tmp_path):
    plane = TensorVolume(spd((4, 5), 2), (0.5, 2.0), (10.0, 20.0), np.indices((4, 5)).sum(0) > 0)
    read = read_tensors(save_tensors(tmp_path / "t.nrrd", plane))
    np.testing.assert_array_equal(read.tensors, plane.tensors)
    np.testing.assert_array_equal(read.mask, plane.mask)
    assert (read.spacing, read.origin, read.affine) == (plane.spacing, plane.origin, None)


def test_the_lost_position_of_a_slice_is_told(tmp_path, volume):
    with pytest.warns(hj.AccuracyWarning, match=r"t\.nrrd: NRRD has no position in space for 2×2 tensors"):
        save_tensors(tmp_path / "t.nrrd", volume.slice("y", 2))


@pytest.mark.parametrize("sliced", [False, True])
def test_results_lie_where_the_tensors_do(tmp_path, volume, sliced):
    where = volume.slice("y", 2) if sliced else volume
    values = np.random.default_rng(0).random((3, *where.shape))
    values[:, ~where.mask] = np.nan
    path = save(tmp_path / "v.nrrd", values, where, name="hks", extra={"times": [0.5, 1, 2]})
    data, header = nrrd.read(str(path), index_order="F")
    assert data.shape == ((4, 1, 6, 3) if sliced else (*SHAPE, 3))
    np.testing.assert_array_equal(data[:, 0] if sliced else data, np.moveaxis(values, 0, -1))
    assert header["space"] == "right-anterior-superior"
    place = header["space directions"][:3].T @ [1, 0, 3] + header["space origin"]
    np.testing.assert_allclose(place, (volume.affine @ [1, 2 if sliced else 0, 3, 1])[:3])
    assert header["times"] == "0.5 1.0 2.0"


def test_results_without_an_affine(tmp_path):
    plane = TensorVolume(np.broadcast_to(np.eye(2), (3, 4, 2, 2)), (0.5, 2.0), (10.0, 20.0))
    data, header = nrrd.read(str(save(tmp_path / "v.nrrd", np.ones((3, 4)), plane)), index_order="F")
    assert data.shape == (3, 4)
    np.testing.assert_array_equal(header["space directions"], np.diag([0.5, 2.0]))
    with pytest.raises(ValueError, match=r"kind of file is unknown; expected .*\.nrrd"):
        save(tmp_path / "v.nhdr", np.ones((3, 4)), plane)


def test_masks_and_labels(tmp_path, volume):
    header = {"space": "left-posterior-superior", "space directions": (LPS @ AXES * SPACING).T}
    header["space origin"] = LPS @ ORIGIN
    nrrd.write(str(tmp_path / "m.nrrd"), volume.mask.astype(np.uint8), header, index_order="F")
    np.testing.assert_array_equal(read_mask(tmp_path / "m.nrrd", volume.affine), volume.mask)
    labels = np.arange(volume.mask.size).reshape(SHAPE) + 3_000_000_000
    nrrd.write(str(tmp_path / "labels.nrrd"), labels, header, index_order="F")
    np.testing.assert_array_equal(read_labels(tmp_path / "labels.nrrd", volume), labels)
    np.testing.assert_array_equal(read_labels(tmp_path / "labels.nrrd", volume.slice("y", 2)), labels[:, 2])
    header["space origin"] = ORIGIN
    nrrd.write(str(tmp_path / "m.nrrd"), volume.mask.astype(np.uint8), header, index_order="F")
    with pytest.raises(ValueError, match="the affine displaces this image"):
        read_mask(tmp_path / "m.nrrd", volume.affine)
