"""Damaged files: what a checksum or a length contradicts is refused by the file's name, never read as another."""

import gzip
import io
import struct
import zipfile

import numpy as np
import pytest

import hks_jax as hj
from hks_jax.inverse import checkpoint
from hks_jax.inverse.metric_fit import Step
from hks_jax.io import dwi
from hks_jax.storage import load_npy, load_npz

AFFINE = np.diag([2.0, 2.0, 2.5, 1.0])


@pytest.fixture
def volume(rng):
    factors = rng.standard_normal((5, 4, 3, 3, 3))
    tensors = np.eye(3) + factors @ np.swapaxes(factors, -1, -2)
    mask = rng.random((5, 4, 3)) < 0.9
    return hj.io.TensorVolume(np.where(mask[..., None, None], tensors, 0), (2.0, 2.0, 2.5), (0.0,) * 3, mask, AFFINE)


def refused(read, path, content):
    """Whether content in place of a file's is refused by name; else it must be read as it was."""
    whole = path.read_bytes()
    before = read(path)
    damaged = path.with_name(f"damaged-{path.name}")
    damaged.write_bytes(content)
    assert content != whole
    after, error = _tried(read, damaged)
    if error is not None:
        assert damaged.name in str(error)
        return True
    for name in ("tensors", "spacing", "origin", "mask", "affine"):
        np.testing.assert_array_equal(getattr(before, name), getattr(after, name))
    return False


def _tried(read, path):
    """What is read, or the library's own error; every other one passes."""
    try:
        return read(path), None
    except ValueError as error:
        if type(error) is not ValueError:
            raise
        return None, error


@pytest.mark.parametrize("name", ["t.nii.gz", "t.npz"])
def test_a_flipped_bit_anywhere_changes_nothing_silently(tmp_path, volume, name, rng):
    path = hj.io.save_tensors(tmp_path / name, volume)
    whole = path.read_bytes()
    count = 0
    for place in rng.integers(0, len(whole), 150):
        content = bytearray(whole)
        content[place] ^= 1 << rng.integers(8)
        count += refused(hj.io.read_tensors, path, bytes(content))
    assert count > 100
    for cut in (1, 4, 9, len(whole) // 2, len(whole) - 3):
        assert refused(hj.io.read_tensors, path, whole[:-cut])


def test_what_follows_compressed_data_is_refused(tmp_path, volume):
    path = hj.io.save_tensors(tmp_path / "t.nii.gz", volume)
    whole = path.read_bytes()
    assert refused(hj.io.read_tensors, path, whole + b"rubbish")
    assert not refused(hj.io.read_tensors, path, whole + bytes(16))  # padding, as tapes have it


def test_compressed_data_of_nrrd_are_read_to_the_checksum(tmp_path, volume, rng):
    path = hj.io.save_tensors(tmp_path / "t.nrrd", volume)
    whole = path.read_bytes()
    start = whole.index(b"\n\n") + 2
    for place in [*rng.integers(start + 10, len(whole), 60), len(whole) - 6, len(whole) - 1]:
        content = bytearray(whole)
        content[place] ^= 1 << rng.integers(8)
        assert refused(hj.io.read_tensors, path, bytes(content))
    for cut in (20, 100):
        assert refused(hj.io.read_tensors, path, whole[:-cut])
    for content in (whole[:-1], whole[:-8], whole + b"rubbish"):  # the data themselves are complete
        refused(hj.io.read_tensors, path, content)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"space directions", b"space direcdions"),  # its default would be a spacing of one
        (b"measurement frame", b"measurement fraue"),
        (b"\nkinds: ", b"\nkinds:="),
        (b"right-anterior-superior", b"right-interior-superior"),
        (b"sizes: 7 5", b"sizes: 7 5 5"),
        (b"sizes: 7 5", b"sizes: 99999999999 5"),
        (b"kinds: 3D", b"kinds: none 3D"),
        (b"(2", b"(\xb2"),
        (b"space origin: (", b"space origin: (1,"),
    ],
)
def test_damaged_headers_of_nrrd(tmp_path, volume, old, new):
    path = hj.io.save_tensors(tmp_path / "t.nrrd", volume)
    whole = path.read_bytes()
    assert old in whole
    assert refused(hj.io.read_tensors, path, whole.replace(old, new, 1))


def test_axes_that_nifti_does_not_know(tmp_path, volume):
    path = hj.io.save_tensors(tmp_path / "t.nii", volume)
    whole = path.read_bytes()
    assert b'"voxel"' in whole
    assert refused(hj.io.read_tensors, path, whole.replace(b'"voxel"', b'"v/xel"'))


def test_nifti_whose_header_contradicts_its_length(tmp_path, volume):
    path = hj.io.save_tensors(tmp_path / "t.nii", volume)
    whole = bytearray(path.read_bytes())
    assert refused(hj.io.read_tensors, path, whole[:-1])
    assert refused(hj.io.read_tensors, path, whole + b"\0")
    for place, value in ((42, 4), (42, 30000), (70, 16), (108, 2**30)):  # dim, datatype, vox_offset
        content = bytearray(whole)
        struct.pack_into("<f" if place == 108 else "<h", content, place, value)
        assert refused(hj.io.read_tensors, path, bytes(content))
    with pytest.raises(ValueError, match=r"u\.nii\.gz: the file is damaged or not a readable NIfTI image"):
        hj.io.read_tensors(_written(tmp_path / "u.nii.gz", gzip.compress(b"no image" * 100)))


def _written(path, content):
    path.write_bytes(content)
    return path


def test_complex_voxels_are_refused(tmp_path):
    nib = pytest.importorskip("nibabel")
    image = nib.Nifti1Image(np.ones((3, 3, 3, 6), np.complex64), AFFINE)
    nib.save(image, tmp_path / "c.nii.gz")
    with pytest.raises(ValueError, match=r"c\.nii\.gz: got voxels of type complex64; expected real"):
        hj.io.read_tensors(tmp_path / "c.nii.gz", "fsl")


def test_arrays_that_are_longer_or_shorter_than_declared(tmp_path):
    stream = io.BytesIO()
    np.save(stream, np.arange(12.0).reshape(4, 3))
    whole = stream.getvalue()
    assert load_npy(_written(tmp_path / "a.npy", whole)).shape == (4, 3)
    for old, new in (
        (b"(4, 3)", b"(2, 3)"),
        (b"(4, 3), }      ", b"(40000000000, 3)"),
        (b"(4, 3), }  ", b"(-4, -3), }"),
        (b"<f8", b"<f4"),
    ):
        content = whole.replace(old, new)
        with pytest.raises(ValueError, match=r"a\.npy: the file is damaged or not a readable npy array"):
            load_npy(_written(tmp_path / "a.npy", content))
        # In an archive the checksum may be right and the array not what it says.
        with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
            archive.writestr("a.npy", content)
        with pytest.raises(ValueError, match=r"a\.npz: the file is damaged or not a readable npz archive"):
            load_npz(tmp_path / "a.npz")
    for content in (whole[:-1], whole + b"\0", whole[:20], b"", whole.replace(b"NUMPY", b"NUMPI")):
        with pytest.raises(ValueError, match=r"a\.npy: the file is damaged or not a readable npy array"):
            load_npy(_written(tmp_path / "a.npy", content))


def test_stored_members_of_an_archive_are_checked(tmp_path):
    np.savez(tmp_path / "a.npz", a=np.arange(100.0))
    content = bytearray((tmp_path / "a.npz").read_bytes())
    content[content.index(np.float64(50).tobytes()) + 7] ^= 1
    with pytest.raises(ValueError, match=r"a\.npz: .*Bad CRC-32"):
        load_npz(_written(tmp_path / "a.npz", content))


def test_checkpoints(tmp_path, rng):
    step = Step(1, 0.5, 0.4, 0.3, True, 2.0, 0, 0)
    file = tmp_path / "fit.npz"
    values = rng.standard_normal((3, 20))
    checkpoint.save(file, "mark", checkpoint.Checkpoint(values, [step], 0, 0, 1.0, values, [0.5]))
    found = checkpoint.load(file, "mark")
    np.testing.assert_array_equal(found.values, values)
    assert found.history == [step]
    whole = file.read_bytes()
    told = 0
    for place in rng.integers(0, len(whole), 100):
        content = bytearray(whole)
        content[place] ^= 1 << rng.integers(8)
        file.write_bytes(content)
        found, error = _tried(lambda path: checkpoint.load(path, "mark"), file)
        if error is None:
            np.testing.assert_array_equal(found.values, values)
        else:
            assert str(error).startswith("checkpoint: ")
            assert file.name in str(error)
            told += 1
    assert told > 60
    np.savez(file, other=values)
    with pytest.raises(ValueError, match=r"checkpoint: .* without best, ended, history"):
        checkpoint.load(file, "mark")


@pytest.mark.parametrize("content", [b"", b"0 1000 x", b"0 nan 3", b"\xff\xfe0 1"])
def test_tables_of_numbers(tmp_path, content):
    with pytest.raises(ValueError, match=r"b\.bval: the file is damaged or not a table of numbers"):
        dwi._numbers(_written(tmp_path / "b.bval", content))


def test_members_that_a_damaged_list_hides(tmp_path):
    np.savez(tmp_path / "a.npz", a=np.zeros(3), mask=np.ones(3))
    content = bytearray((tmp_path / "a.npz").read_bytes())
    entries = [i for i in range(len(content)) if content[i : i + 4] == b"PK\x01\x02"]
    content[entries[0] + 32] = (
        content.index(b"PK\x05\x06") - entries[1]
    )  # the length of the first entry's comment: the next entry
    with pytest.raises(ValueError, match=r"its end record states 2 members, but its list has 1"):
        load_npz(_written(tmp_path / "a.npz", content))


MESH = (np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.5]]), np.array([[0, 1, 2], [1, 3, 2]]))


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("m.ply", b"element vertex 4", b"element vertex 99999999999"),  # meshio would ask for as much memory
        ("m.ply", b"element face 2", b"element face 1"),
        ("m.vtk", b"POINTS 4", b"POINTS 99999999999"),
        ("m.vtk", b"CELL_TYPES 2", b"CELL_TYPES 1"),
        ("m.vtk", b"\x00\x05\n", b"\x08\x05\n"),  # a type that meshio passes over
        ("m.vtu", b'NumberOfCells="2"', b'NumberOfCells="3"'),
        ("m.off", b"4 2 0", b"4 1 0"),
        ("m.off", b"4 2 0", b"99999999999 2 0"),
    ],
)
def test_meshes_that_hold_something_else_than_they_declare(tmp_path, name, old, new):
    meshio = pytest.importorskip("meshio")
    path = tmp_path / name
    meshio.Mesh(MESH[0], [("triangle", MESH[1].astype(np.int32))]).write(path)
    assert len(hj.io.read_mesh(path).faces) == 2
    whole = path.read_bytes()
    assert old in whole
    with pytest.raises(
        ValueError, match=f"{name}: the file is damaged or not a (mesh that meshio can read|readable (OFF|PLY) mesh)"
    ) as told:
        hj.io.read_mesh(_written(path, whole.replace(old, new, 1)))
    assert not isinstance(told.value.__cause__, MemoryError)


def test_whatever_meshio_raises_is_one_error(tmp_path, rng):
    meshio = pytest.importorskip("meshio")
    for name in ("m.ply", "m.vtk", "m.vtu", "m.off", "m.stl", "m.obj"):
        path = tmp_path / name
        meshio.Mesh(MESH[0], [("triangle", MESH[1].astype(np.int32))]).write(path)
        whole = path.read_bytes()
        for _ in range(30):
            place = int(rng.integers(len(whole)))
            content = whole[:place] + rng.bytes(8) + whole[place + 8 :]
            _, error = _tried(hj.io.read_mesh, _written(path, content))
            assert error is None or name in str(error)


@pytest.mark.slow
def test_checks_of_random_files_pass():
    from stress.files import check

    outcomes = [check(seed) for seed in range(200)]
    assert outcomes.count("refused") > 100
