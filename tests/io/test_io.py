"""Files: what is written is what is read, by this package and by nibabel."""

import gzip
import hashlib
import importlib.metadata
import json
import os
import stat
import sys
from dataclasses import replace

import nibabel as nib
import numpy as np
import pytest
from annotations import unchecked
from dipy.core.gradients import gradient_table
from dipy.io.gradients import read_bvals_bvecs
from dipy.io.utils import nifti1_symmat
from dipy.reconst.dti import TensorModel, lower_triangular
from dipy.segment.mask import median_otsu

import hks_jax as hj
from hks_jax.io import ORDERS, TensorVolume, atomic_folder, atomic_path, erode, find_example_brain, read_mask
from hks_jax.io.json_files import tuples
from hks_jax.io.tensor_order import pack, to_voxel_axes, unpack

SHAPE = (4, 5, 6)


def rotated_affine():
    """A rotation, a flip, anisotropic voxels and a translation: nothing that could be guessed."""
    a, b = 0.3, -0.7
    rz = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    rx = np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
    affine = np.eye(4)
    affine[:3, :3] = rz @ rx @ np.diag([-1.5, 2.0, 3.25])
    affine[:3, 3] = 11.0, -7.0, 3.0
    return affine


@pytest.fixture
def tensors():
    root = np.random.default_rng(3).normal(size=(*SHAPE, 3, 3))
    return 1e-3 * (root @ np.swapaxes(root, -1, -2) + np.eye(3))


@pytest.fixture
def volume(tensors):
    mask = np.ones(SHAPE, bool)
    mask[0] = False
    affine = rotated_affine()
    spacing = tuple(np.linalg.norm(affine[:3, :3], axis=0).tolist())
    return TensorVolume(tensors, spacing, (0.0, 0.0, 0.0), mask, affine)


def write_components(path, components, affine, intent=False):
    image = nib.Nifti1Image(components, affine)
    if intent:
        image.header.set_intent("symmetric matrix", (3,))
    nib.save(image, path)
    return path


# ---------------------------------------------------------------------------------------------------- tensors


@pytest.mark.parametrize("suffix", [".nii", ".nii.gz"])
def test_symmetric_matrix_image_of_nibabel_is_read_in_its_order(tmp_path, tensors, suffix):
    names = [("x", "x"), ("x", "y"), ("y", "y"), ("x", "z"), ("y", "z"), ("z", "z")]
    components = np.stack([tensors[..., "xyz".index(a), "xyz".index(b)] for a, b in names], -1)
    path = write_components(tmp_path / f"t{suffix}", components[..., None, :], rotated_affine(), intent=True)
    read = hj.io.read_tensors(path)
    np.testing.assert_array_equal(read.tensors, tensors)
    assert read.order == "nifti"
    np.testing.assert_allclose(read.spacing, [1.5, 2.0, 3.25], rtol=1e-6)
    np.testing.assert_allclose(read.affine, rotated_affine(), rtol=1e-6)


def test_written_tensors_are_what_nibabel_and_we_read(tmp_path, volume):
    path = hj.io.save_tensors(tmp_path / "t.nii.gz", volume)
    image = nib.load(path)
    assert image.shape == (*SHAPE, 1, 6)
    assert image.header.get_intent()[:2] == ("symmetric matrix", (3.0,))
    np.testing.assert_allclose(image.affine, volume.affine, rtol=1e-6)
    inside = volume.mask
    np.testing.assert_array_equal(image.get_fdata()[inside, 0, 3], volume.tensors[inside, 0, 2])
    np.testing.assert_array_equal(hj.io.read_tensors(path).tensors[inside], volume.tensors[inside])
    assert not image.get_fdata()[~inside].any()


@pytest.mark.parametrize("extra_axis", [False, True])
def test_six_components_of_undeclared_order_are_refused_with_the_choices(tmp_path, tensors, extra_axis):
    components = pack(tensors, "fsl")
    path = write_components(tmp_path / "t.nii", components[..., None, :] if extra_axis else components, np.eye(4))
    with pytest.raises(ValueError, match="does not declare their order") as caught:
        hj.io.read_tensors(path)
    for name, order in ORDERS.items():
        assert f'"{name}" ({" ".join(order)})' in str(caught.value)


@pytest.mark.parametrize("order", list(ORDERS))
def test_every_order_unpacks_to_the_same_tensors(tmp_path, tensors, order):
    np.testing.assert_array_equal(unpack(pack(tensors, order), order), tensors)
    path = write_components(tmp_path / "t.nii", pack(tensors, order), rotated_affine())
    read = hj.io.read_tensors(path, order=order, frame="voxel")
    np.testing.assert_array_equal(read.tensors, tensors)


def test_orders_are_those_of_their_programs():
    assert " ".join(ORDERS["nifti"]) == "xx xy yy xz yz zz"
    assert " ".join(ORDERS["fsl"]) == "xx xy xz yy yz zz"
    assert " ".join(ORDERS["mrtrix"]) == "xx yy zz xy xz yz"


def test_world_tensors_are_turned_to_the_voxel_axes(tmp_path):
    affine = rotated_affine()
    axes = affine[:3, :3] / np.linalg.norm(affine[:3, :3], axis=0)
    voxel = np.diag([3.0, 2.0, 1.0])  # along the voxel axes, whatever these are in the world
    world = axes @ voxel @ axes.T
    path = write_components(tmp_path / "t.nii", np.broadcast_to(pack(world, "mrtrix"), (*SHAPE, 6)).copy(), affine)
    read = hj.io.read_tensors(path, order="mrtrix")
    np.testing.assert_allclose(read.tensors, np.broadcast_to(voxel, (*SHAPE, 3, 3)), atol=1e-6)


def test_fsl_frame_reverses_x_only_where_the_affine_keeps_orientation(tensors):
    right_handed, left_handed = np.diag([2.0, 2, 2, 1]), np.diag([-2.0, 2, 2, 1])
    flipped = to_voxel_axes(tensors, "fsl", right_handed)
    np.testing.assert_array_equal(flipped[..., 0, 1], -tensors[..., 0, 1])
    np.testing.assert_array_equal(flipped[..., 1, 2], tensors[..., 1, 2])
    np.testing.assert_array_equal(to_voxel_axes(tensors, "fsl", left_handed), tensors)


def test_big_endian_and_scaled_images_become_native_floats(tmp_path, tensors):
    components = pack(tensors, "nifti")[..., None, :]
    for dtype, expected, tolerance in ((np.float32, "=f4", 1e-6), (np.int16, "=f8", 1e-4)):
        header = nib.Nifti1Header(endianness=">")
        header.set_data_dtype(dtype)
        header.set_intent("symmetric matrix", (3,))
        nib.save(nib.Nifti1Image(components, np.eye(4), header), tmp_path / "t.nii")
        read = hj.io.read_tensors(tmp_path / "t.nii").tensors
        assert read.dtype == np.dtype(expected)
        assert read.dtype.isnative
        np.testing.assert_allclose(read, tensors, atol=tolerance * np.abs(tensors).max())


def test_npz_round_trip_keeps_everything(tmp_path, volume):
    plane = volume.slice("y", 2)
    for v in (volume, plane):
        read = hj.io.read_tensors(hj.io.save_tensors(tmp_path / "t.npz", v))
        np.testing.assert_array_equal(read.tensors, v.tensors)
        np.testing.assert_array_equal(read.mask, v.mask)
        np.testing.assert_array_equal(read.affine, v.affine)
        assert (read.spacing, read.origin, read.slice_axis) == (v.spacing, v.origin, v.slice_axis)


def test_npz_defaults(tmp_path):
    np.savez(tmp_path / "t.npz", tensors=np.broadcast_to(np.eye(2, dtype=int), (3, 4, 2, 2)))
    read = hj.io.read_tensors(tmp_path / "t.npz")
    assert (read.spacing, read.origin, read.mask, read.affine) == ((1.0, 1.0), (0.0, 0.0), None, None)
    assert read.tensors.dtype == np.float64


@pytest.mark.parametrize(("d", "order"), [(d, order) for d in (2, 3) for order in ORDERS])
def test_components_in_npy_and_npz(tmp_path, tensors, d, order):
    whole = tensors if d == 3 else tensors[:, :, 0, :2, :2]
    names = [(a, b) for a, b in ORDERS[order] if d == 3 or "z" not in (a, b)]
    components = np.stack([whole[..., "xyz".index(a), "xyz".index(b)] for a, b in names], -1)
    np.save(tmp_path / "t.npy", components)
    read = hj.io.read_tensors(tmp_path / "t.npy", order, spacing=0.5)
    np.testing.assert_array_equal(read.tensors, whole)
    assert (read.order, read.spacing) == (order, (0.5,) * d)
    with pytest.raises(ValueError, match="does not declare their order, which depends"):
        hj.io.read_tensors(tmp_path / "t.npy")
    np.savez(tmp_path / "t.npz", D=components, order=order, spacing=np.ones(d))
    np.testing.assert_array_equal(hj.io.read_tensors(tmp_path / "t.npz", array="D").tensors, whole)
    with pytest.raises(ValueError, match=r"spacing: .* declares"):
        hj.io.read_tensors(tmp_path / "t.npz", array="D", spacing=2.0)


def test_frames_in_npz(tmp_path, tensors):
    axes = rotated_affine()[:3, :3] / [1.5, 2.0, 3.25]
    np.savez(tmp_path / "t.npz", tensors=axes @ tensors @ axes.T, affine=rotated_affine(), frame="world")
    read = hj.io.read_tensors(tmp_path / "t.npz")
    np.testing.assert_allclose(read.tensors, tensors, rtol=1e-9, atol=1e-15)
    assert read.frame == "world"
    np.save(tmp_path / "t.npy", tensors)
    with pytest.raises(ValueError, match="no 3×3 tensors with an affine"):
        hj.io.read_tensors(tmp_path / "t.npy", frame="world")


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"D": np.eye(2)}, "got the arrays D; expected 'tensors'"),
        ({"tensors": np.zeros((3, 4, 5))}, "expected \\(nx, ny, 2, 2\\) or \\(nx, ny, nz, 3, 3\\)"),
        ({"tensors": np.zeros((3, 4, 2, 2)), "spacing": [1, 2, 3]}, "spacing: got .* expected 2 finite numbers"),
        ({"tensors": np.zeros((3, 4, 2, 2)), "mask": np.ones((4, 3))}, "mask: got bool \\(4, 3\\)"),
        ({"tensors": np.zeros((3, 4, 2, 2)), "mask": np.full((3, 4), 0.5)}, "values other than 0 and 1"),
        ({"tensors": np.zeros((3, 4, 2, 2), complex)}, "dtype complex128; expected real numbers"),
    ],
)
def test_bad_npz(tmp_path, arrays, message):
    np.savez(tmp_path / "t.npz", **arrays)
    with unchecked(), pytest.raises(ValueError, match=message):
        hj.io.read_tensors(tmp_path / "t.npz")


def test_unreadable_files(tmp_path, tensors):
    with pytest.raises(FileNotFoundError, match="no such file"):
        hj.io.read_tensors(tmp_path / "absent.nii.gz")
    (tmp_path / "t.mha").write_text("")
    with pytest.raises(ValueError, match=r"kind of file is unknown; expected \.nii, \.nii\.gz, \.mif"):
        hj.io.read_tensors(tmp_path / "t.mha")
    for name in ("t.nii", "t.nii.gz", "t.npz"):
        (tmp_path / name).write_bytes(b"not what the name says")
        with pytest.raises(ValueError, match="not a readable"):
            hj.io.read_tensors(tmp_path / name)
    whole = write_components(tmp_path / "w.nii.gz", pack(tensors, "nifti")[..., None, :], np.eye(4), intent=True)
    (tmp_path / "cut.nii").write_bytes(gzip.decompress(whole.read_bytes())[:800])
    with pytest.raises(ValueError, match=r"cut\.nii: the file is damaged or not a readable NIfTI image.*got 800 bytes"):
        hj.io.read_tensors(tmp_path / "cut.nii")


def test_an_image_that_is_no_tensor_image_is_refused(tmp_path):
    write_components(tmp_path / "dwi.nii", np.zeros((3, 3, 3, 7)), np.eye(4))
    with pytest.raises(ValueError, match=r"expected six components per voxel.*fit_dwi"):
        hj.io.read_tensors(tmp_path / "dwi.nii")


@pytest.mark.parametrize(
    ("module", "name", "extra"),
    [
        ("nibabel", "t.nii", "dti"),
        ("nrrd", "t.nrrd", "nrrd"),
        ("vtkmodules.vtkIOXML", "t.vti", "vtk"),
        ("meshio", "m.vtu", "mesh"),
    ],
)
def test_of_a_missing_library_the_extra_is_named(tmp_path, monkeypatch, module, name, extra):
    monkeypatch.setitem(sys.modules, module, None)
    (tmp_path / name).write_text("")
    read = hj.io.read_mesh if extra == "mesh" else hj.io.read_tensors
    with pytest.raises(ImportError, match=rf'pip install "hks-jax\[{extra}\]"'):
        read(tmp_path / name)


# ---------------------------------------------------------------------------------------------------- slices


@pytest.mark.parametrize(("axis", "keep"), [("x", (1, 2)), ("y", (0, 2)), (2, (0, 1))])
def test_slice_carries_the_in_plane_block_and_its_place(volume, axis, keep):
    a = "xyz".find(axis) if isinstance(axis, str) else axis
    plane = volume.slice(axis, 3)
    assert plane.shape == tuple(SHAPE[b] for b in keep)
    assert plane.spacing == tuple(volume.spacing[b] for b in keep)
    np.testing.assert_array_equal(plane.tensors, np.take(volume.tensors, 3, a)[..., keep, :][..., keep])
    np.testing.assert_array_equal(plane.mask, np.take(volume.mask, 3, a))
    index = np.array([1, 1, 1, 1])
    index[a] = 0
    in_volume = index + 3 * np.eye(4, dtype=int)[a]
    np.testing.assert_allclose(plane.affine @ index, volume.affine @ in_volume)


def test_the_block_is_of_the_diffusion_tensor_not_of_its_inverse():
    D = np.array([[2.0, 0.3, 0.5], [0.3, 1.0, 0.2], [0.5, 0.2, 1.5]])
    volume = TensorVolume(np.broadcast_to(D, (3, 3, 3, 3, 3)), (1.0,) * 3, (0.0,) * 3)
    plane = volume.slice("z", 1)
    metric = np.asarray(hj.TensorField.from_diffusion(plane.grid(), plane.tensors, "inverse").tensors[0, 0])
    np.testing.assert_allclose(metric, np.linalg.inv(D[:2, :2]), rtol=1e-6)
    assert np.abs(metric - np.linalg.inv(D)[:2, :2]).max() > 0.03


def test_bad_slices(volume):
    with pytest.raises(ValueError, match="index: got z = 6; expected 0 … 5"):
        volume.slice("z", 6)
    with pytest.raises(ValueError, match="axis: got 'w'"):
        volume.slice("w", 0)
    with pytest.raises(ValueError, match="no voxels in slice x = 0; the mask has voxels at x = 1 … 3"):
        volume.slice("x", 0)
    with pytest.raises(ValueError, match="got a slice; expected a volume"):
        volume.slice("z", 0).slice("z", 0)


# ---------------------------------------------------------------------------------------------------- masks


def test_masks_of_every_kind_of_file(tmp_path, volume):
    np.save(tmp_path / "m.npy", volume.mask)
    np.savez(tmp_path / "m.npz", mask=volume.mask)
    write_components(tmp_path / "m.nii.gz", volume.mask.astype(np.uint8)[..., None], volume.affine)
    for name in ("m.npy", "m.npz", "m.nii.gz"):
        np.testing.assert_array_equal(read_mask(tmp_path / name), volume.mask)
    moved = volume.affine @ np.diag([-1.0, 1, 1, 1])
    np.savez(tmp_path / "m.npz", mask=volume.mask, affine=moved)
    with pytest.raises(ValueError, match=r"m\.npz: the affine displaces this image"):
        read_mask(tmp_path / "m.npz", volume.affine)
    np.savez(tmp_path / "m.npz", mask=volume.mask, affine=moved[:3])
    with pytest.raises(ValueError, match=r"m\.npz: affine: got .*; expected an invertible matrix of shape \(4, 4\)"):
        read_mask(tmp_path / "m.npz", volume.affine)


def test_bad_masks(tmp_path, volume):
    hj.io.save_tensors(tmp_path / "t.nii", volume)
    np.save(tmp_path / "m.npy", np.ones((4, 5)))
    with pytest.raises(ValueError, match=r"mask: got shape \(4, 5\); expected the shape of the image, \(4, 5, 6\)"):
        hj.io.read_tensors(tmp_path / "t.nii", mask=tmp_path / "m.npy")
    elsewhere = volume.affine.copy()
    elsewhere[0, 3] += 2.0
    write_components(tmp_path / "m.nii", volume.mask.astype(np.uint8), elsewhere)
    with pytest.raises(ValueError, match="displaces this image by up to 2 from"):
        hj.io.read_tensors(tmp_path / "t.nii", mask=tmp_path / "m.nii")
    np.savez(tmp_path / "m.npz", inside=volume.mask)
    with pytest.raises(ValueError, match="got the arrays inside; expected an array 'mask'"):
        read_mask(tmp_path / "m.npz")


def test_erosion_peels_the_rim_but_not_the_border_of_the_image():
    mask = np.zeros((9, 9, 2), bool)
    mask[1:8, 1:8] = True
    eroded = erode(mask, 2)
    assert eroded.sum() == 3 * 3 * 2
    assert eroded[3:6, 3:6].all()
    assert erode(mask, 0) is mask
    with pytest.raises(ValueError, match="removes all 98 voxels"):
        erode(mask, 4)
    with pytest.raises(ValueError, match="iterations: got -1; expected an integer of at least 0"):
        erode(mask, -1)


# ---------------------------------------------------------------------------------------------------- results


def test_values_of_a_volume_carry_times_along_the_fourth_axis(tmp_path, volume):
    values = np.random.default_rng(0).random((7, *SHAPE))
    values[:, ~volume.mask] = np.nan
    image = nib.load(hj.io.save(tmp_path / "v.nii.gz", values, volume))
    assert image.shape == (*SHAPE, 7)
    np.testing.assert_array_equal(image.get_fdata(), np.moveaxis(values, 0, -1))
    np.testing.assert_allclose(image.affine, volume.affine, rtol=1e-6)
    assert nib.load(hj.io.save(tmp_path / "one.nii", values[0], volume)).shape == SHAPE


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_values_of_a_slice_lie_where_the_slice_was_cut(tmp_path, volume, axis):
    field = np.random.default_rng(1).random(SHAPE)
    a, index = "xyz".index(axis), 2
    plane = volume.slice(axis, index)
    values = np.stack([np.take(field, index, a), 2 * np.take(field, index, a)])
    image = nib.load(hj.io.save(tmp_path / "v.nii.gz", values, plane))
    assert image.shape == (*[1 if b == a else n for b, n in enumerate(SHAPE)], 2)
    # The voxel of the slice at a place in the world holds what the volume's voxel at that place held.
    node = np.array([1, 1, 1])
    node[a] = index
    world = volume.affine @ [*node, 1]
    i, j, k = np.rint(np.linalg.inv(image.affine) @ world).astype(int)[:3]
    assert image.get_fdata()[i, j, k, 1] == 2 * field[tuple(node)]


def test_a_slice_without_affine_is_placed_by_spacing_and_origin(tmp_path):
    plane = TensorVolume(np.broadcast_to(np.eye(2), (3, 4, 2, 2)), (0.5, 2.0), (10.0, 20.0))
    image = nib.load(hj.io.save(tmp_path / "v.nii", np.zeros((3, 4)), plane))
    assert image.shape == (3, 4, 1)
    np.testing.assert_array_equal(image.affine @ [2, 1, 0, 1], [11.0, 22.0, 0.0, 1.0])


def test_a_nifti_says_where_it_came_from(tmp_path, volume):
    scan = hj.io.save_tensors(tmp_path / "t.nii.gz", volume)
    read = hj.io.read_tensors(scan)
    path = hj.io.save(tmp_path / "v.nii.gz", np.zeros(SHAPE), read, provenance={"settings": {"k": np.int64(7)}})
    (extension,) = nib.load(path).header.extensions
    record = json.loads(extension.get_content())
    assert extension.get_code() == 6  # a comment
    assert record["source"] == str(scan)
    assert record["sha256"] == hashlib.sha256(scan.read_bytes()).hexdigest()
    assert (record["order"], record["frame"], record["settings"]) == ("nifti", "voxel", {"k": 7})
    assert record["software"] == f"hks-jax {hj.__version__}"


def test_npz_results(tmp_path, volume):
    plane = volume.slice("z", 1)
    hj.io.save(tmp_path / "v.npz", np.ones((2, 4, 5)), plane, name="hks", extra={"times": [1.0, 2.0]})
    with np.load(tmp_path / "v.npz") as read:
        assert set(read.files) == {"hks", "times", "spacing", "origin", "mask", "affine", "slice_axis", "provenance"}
        np.testing.assert_array_equal(read["times"], [1, 2])
        np.testing.assert_array_equal(read["mask"], plane.mask)


def test_times_of_an_image_are_beside_it(tmp_path, volume):
    hj.io.save(tmp_path / "v.nii.gz", np.zeros((2, *SHAPE)), volume, name="hks", extra={"times": np.array([1.0, 2.5])})
    about = {"Quantity": "hks", "Times": [1.0, 2.5], "Sources": [], "OrientationEncoding": {"Type": "scalar"}}
    assert json.loads((tmp_path / "v.json").read_text()) == about


def test_results_that_cannot_be_saved(tmp_path, volume):
    with pytest.raises(ValueError, match=r"values: got shape \(5, 4, 6\); expected \(4, 5, 6\)"):
        hj.io.save(tmp_path / "v.npz", np.zeros((5, 4, 6)), volume)
    with pytest.raises(ValueError, match=r"kind of file is unknown; expected \.nii\.gz, \.nii, \.nrrd, \.vti, \.npz"):
        hj.io.save(tmp_path / "v.txt", np.zeros(SHAPE), volume)
    with pytest.raises(ValueError, match="expected only times for NIfTI"):
        hj.io.save(tmp_path / "v.nii", np.zeros(SHAPE), volume, extra={"eigenvalues": [1]})
    with pytest.raises(ValueError, match="slice_axis: got 3 for 2 axes"):
        replace(volume.slice("z", 1), slice_axis=3)
    with pytest.raises(ValueError, match=r"affine: got \[\[0.0, .* expected an invertible matrix"):
        replace(volume, affine=np.zeros((4, 4)))
    with pytest.raises(ValueError, match="unit: got 'um2/ms'; expected 'mm²/s' or nothing"):
        replace(volume, unit="um2/ms")
    with pytest.raises(ValueError, match="no 2×2 tensors"):
        hj.io.save_tensors(tmp_path / "v.nii", volume.slice("z", 1))
    assert list(tmp_path.iterdir()) == []


# ---------------------------------------------------------------------------------------------------- atomicity


@pytest.mark.parametrize("name", ["v.npz", "v.nii.gz"])
def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path, volume, monkeypatch, name):
    path = hj.io.save(tmp_path / name, np.zeros(SHAPE), volume)
    before = path.read_bytes()

    def half(*args, **kwargs):
        target = args[0] if name.endswith("npz") else args[1]
        target.write(b"half") if hasattr(target, "write") else target.write_bytes(b"half")
        raise OSError("disk full")

    owner = np if name.endswith("npz") else nib
    monkeypatch.setattr(owner, "savez_compressed" if name.endswith("npz") else "save", half)
    with pytest.raises(OSError, match="disk full"):
        hj.io.save(path, np.ones(SHAPE), volume)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_an_interrupt_leaves_nothing(tmp_path):
    def interrupted(file):
        file.write_text("half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), atomic_path(tmp_path / "new" / "file") as temporary:
        interrupted(temporary)
    assert list((tmp_path / "new").iterdir()) == []
    with pytest.raises(KeyboardInterrupt), atomic_folder(tmp_path / "a" / "b") as folder:
        interrupted(folder / "file")
    assert not (tmp_path / "a").exists()


def test_a_folder_replaces_its_own_files_only(tmp_path, monkeypatch):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "old").write_text("kept")
    (tmp_path / "out" / "file").write_text("replaced")
    monkeypatch.chdir(tmp_path / "out")
    with atomic_folder(".") as temporary:
        (temporary / "file").write_text("new")
        assert (tmp_path / "out" / "file").read_text() == "replaced"
        assert temporary.resolve().parent == tmp_path / "out"  # the parent may be on another drive
    assert {f.name: f.read_text() for f in (tmp_path / "out").iterdir()} == {"old": "kept", "file": "new"}
    assert [f.name for f in tmp_path.iterdir()] == ["out"]
    with pytest.raises(NotADirectoryError, match="got a file"), atomic_folder(tmp_path / "out" / "old"):
        pass


def test_written_files_have_ordinary_permissions(tmp_path, volume):
    umask = os.umask(0o022)
    try:
        path = hj.io.save(tmp_path / "v.npz", np.zeros(SHAPE), volume)
    finally:
        os.umask(umask)
    assert stat.S_IMODE(path.stat().st_mode) == 0o644


# ---------------------------------------------------------------------------------------------------- tensor fits


@pytest.fixture
def scan(tmp_path, volume):
    """Noise-free diffusion-weighted images of the volume's tensors, with a second shell that no tensor explains."""
    rng = np.random.default_rng(5)
    directions = rng.normal(size=(25, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    b = np.array([0.0] * 2 + [800.0] * 13 + [2500.0] * 10)
    directions[b == 0] = 0
    exponent = np.einsum("na,xyzab,nb->xyzn", directions, volume.tensors, directions) * b
    signal = 1000 * np.exp(-exponent)
    signal[..., b > 2000] = 40.0
    write_components(tmp_path / "dwi.nii.gz", signal, volume.affine)
    np.savetxt(tmp_path / "b", b[None])
    fsl = directions * [-1 if np.linalg.det(volume.affine[:3, :3]) > 0 else 1, 1, 1]
    np.savetxt(tmp_path / "g", fsl.T)
    return tmp_path


def test_fit_recovers_the_tensors_of_a_perfect_scan(scan, volume):
    fit = hj.io.fit_dwi(scan / "dwi.nii.gz", scan / "b", scan / "g", volume.mask, b_max=1000)
    np.testing.assert_allclose(fit.tensors[volume.mask], volume.tensors[volume.mask], rtol=1e-5, atol=1e-8)
    assert not fit.tensors[~volume.mask].any()
    np.testing.assert_allclose(fit.spacing, volume.spacing, rtol=1e-6)
    assert fit.notes[0] == "weighted least-squares fit to 15 of 25 images (2 at b = 0, 13 at b = 800 s/mm²)"


@pytest.mark.parametrize("flip", [1, -1])
def test_tensors_that_dipy_fitted_and_wrote(tmp_path, flip):
    """DIPY's tensors are along the axes of its b-vectors, FSL's here; the file declares the order only."""
    affine = rotated_affine() @ np.diag([flip, 1, 1, 1])
    directions = np.random.default_rng(0).normal(size=(13, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    b = np.array([0.0] + [1000.0] * 12)
    D = 1e-3 * np.array([[1.7, 0.3, 0.2], [0.3, 0.6, 0.1], [0.2, 0.1, 0.4]])  # along FSL's axes
    signal = np.broadcast_to(1000 * np.exp(-b * np.einsum("na,ab,nb->n", directions, D, directions)), (3, 4, 5, 13))
    write_components(tmp_path / "d.nii.gz", signal.copy(), affine)
    np.savetxt(tmp_path / "b", b[None])
    np.savetxt(tmp_path / "g", directions.T)
    table = gradient_table(b, bvecs=read_bvals_bvecs(str(tmp_path / "b"), str(tmp_path / "g"))[1])
    theirs = TensorModel(table).fit(signal)
    nib.save(nifti1_symmat(lower_triangular(theirs.quadratic_form), affine), tmp_path / "t.nii.gz")

    read = hj.io.read_tensors(tmp_path / "t.nii.gz", frame="fsl")
    ours = hj.io.fit_dwi(tmp_path / "d.nii.gz", tmp_path / "b", tmp_path / "g", np.ones((3, 4, 5), bool))
    np.testing.assert_allclose(read.tensors, ours.tensors, rtol=1e-6, atol=1e-12)
    axes = affine[:3, :3] / np.linalg.norm(affine[:3, :3], axis=0)
    sign = np.diag([-1.0 if np.linalg.det(affine) > 0 else 1.0, 1, 1])
    np.testing.assert_allclose(axes @ read.tensors[0, 0, 0] @ axes.T, axes @ sign @ D @ sign @ axes.T, rtol=1e-4)
    note = 'pass frame="fsl"'
    assert any(note in text for text in hj.io.read_tensors(tmp_path / "t.nii.gz").notes) == (np.linalg.det(affine) > 0)


def test_a_scan_without_a_mask_is_masked_by_dipy(tmp_path):
    shape = (24, 26, 10)
    i, j, _ = (2 * a / (n - 1) - 1 for a, n in zip(np.indices(shape), shape, strict=True))
    brain = i**2 + j**2 < 0.6
    directions = np.random.default_rng(0).normal(size=(13, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    b = np.array([0.0] + [1000.0] * 12)
    exponent = b * np.einsum("na,ab,nb->n", directions, 1e-3 * np.diag([1.7, 0.6, 0.4]), directions)
    write_components(tmp_path / "d.nii", np.where(brain[..., None], 1000 * np.exp(-exponent), 10.0), np.eye(4))
    np.savetxt(tmp_path / "b", b[None])
    np.savetxt(tmp_path / "g", directions.T)
    fit = hj.io.fit_dwi(tmp_path / "d.nii", tmp_path / "b", tmp_path / "g")
    np.testing.assert_array_equal(fit.mask, median_otsu(np.where(brain, 1000.0, 10.0))[1])
    assert not fit.mask[~brain].any()
    assert fit.mask.sum() > 0.5 * brain.sum()
    assert np.linalg.eigvalsh(fit.tensors[fit.mask]).min() > 3.9e-4
    assert fit.notes[1] == f"no mask given: DIPY's median_otsu finds {fit.mask.sum()} voxels in the unweighted images"


def test_bad_scans(scan, volume):
    names = scan / "dwi.nii.gz", scan / "b", scan / "g"
    with pytest.raises(ValueError, match=r"b_max: got 10: the 2 images .* only 1 of the 7.*Raise the limit"):
        hj.io.fit_dwi(*names, volume.mask, b_max=10)
    np.savetxt(scan / "short", np.zeros((1, 7)))
    with pytest.raises(ValueError, match="7 b-values"):
        hj.io.fit_dwi(names[0], scan / "short", names[2], volume.mask)
    with pytest.raises(ValueError, match="expected the shape of the image"):
        hj.io.fit_dwi(*names, np.ones((2, 2, 2), bool))


def test_the_example_brain_is_found_by_metadata_alone(tmp_path, monkeypatch):
    def absent(name):
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "files", absent)
    assert find_example_brain() is None

    class Entry:
        def __init__(self, name):
            self.name = name

        def locate(self):
            return tmp_path / self.name

    stem = "b1k_b2k_example_slices_24_38"
    names = [f"{stem}.nii.gz", f"{stem}_mask.nii.gz", "b1k_b2k.bval", "b1k_b2k.bvec"]
    monkeypatch.setattr(importlib.metadata, "files", lambda name: [Entry(n) for n in [*names, "other.py"]])
    assert find_example_brain() is None  # listed, but not on disk
    for name in names:
        (tmp_path / name).touch()
    found = find_example_brain()
    assert found is not None
    assert found.images == tmp_path / names[0]
    assert (found.mask, found.bval, found.bvec) == tuple(tmp_path / n for n in names[1:])


# ---------------------------------------------------------------------------------------------------- results


@pytest.mark.parametrize("times", [np.array([1.0, 2.5]), np.zeros(0)], ids=["over times", "without"])
def test_results_come_back_as_they_were_saved(tmp_path, rng, times):
    affine = np.array([[0, -2.0, 0, 5], [2.0, 0, 0, -3], [0, 0, -3.0, 1], [0, 0, 0, 1]])
    tensors, mask = np.broadcast_to(np.diag([1.0, 2.0]), (6, 5, 2, 2)), rng.random((6, 5)) < 0.9
    about = {"order": "fit", "notes": ("fitted",), "source": "dwi.nii", "digest": "0f"}
    about |= {"length_unit": "mm", "unit": "mm²/s"}
    volume = TensorVolume(tensors, (2.0, 3.0), (1.0, 0.0), mask, affine, 1, **about)
    values = np.where(mask, rng.random((max(times.size, 1), 6, 5)), np.nan)
    settings = {"metric": "inverse", "normalisation": "flat", "boundary": (("neumann", "mean"), "periodic")}
    arrays = {"deviation": 0.1 + values, "z": 2 * values} if times.size else {}
    result = hj.io.Result(volume, values, times, np.arange(3.0), {"settings": settings}, arrays)
    result.save(tmp_path / "hks", "")
    read = hj.io.Result.read(tmp_path, over_times=bool(times.size))
    assert hj.io.Result.read(str(tmp_path / "hks.npz")).source == str(tmp_path / "hks.npz")
    for name in ("values", "times", "eigenvalues"):
        np.testing.assert_array_equal(getattr(read, name), getattr(result, name))
    for name in ("tensors", "mask", "affine", "spacing", "origin", "slice_axis", *about):
        np.testing.assert_array_equal(getattr(read.volume, name), getattr(volume, name))
    assert tuples(read.settings["boundary"]) == settings["boundary"]
    assert (read.unit, read.length_unit) == ("s", "mm")
    bare = replace(volume, length_unit="", unit="")  # an affine alone, such as of VTK's files, declares no unit
    assert (replace(result, place=bare).unit, replace(result, place=bare).length_unit) == ("", "")
    if times.size:
        assert repr(read) == f"Result(hks: float64 (2, 6, 5), 2 times 1 … 2.5 s, source='{tmp_path / 'hks.npz'}')"
        np.testing.assert_array_equal(read.z, 2 * values)
    else:
        assert read.z is None


def test_a_result_on_a_mesh_has_no_volume(tmp_path):
    mesh = hj.examples.ball_mesh(2)
    values = np.ones((1, len(mesh.vertices)))
    hj.io.Result(mesh, values, np.array([1.0]), np.zeros(0), {"settings": {}}).save(tmp_path / "hks", "")
    read = hj.io.Result.read(tmp_path)
    np.testing.assert_array_equal(read.place.cells, mesh.cells)
    assert (read.settings, read.unit) == ({}, "")
    with pytest.raises(ValueError, match=r"hks\.npz: got a result on a mesh"):
        read.volume  # noqa: B018


def test_what_a_file_cannot_hold_is_refused(tmp_path):
    volume = hj.io.TensorVolume(np.broadcast_to(np.eye(2), (4, 3, 2, 2)), (1.0, 2.0), (0.0, 0.0))
    values, path = np.ones((4, 3)), tmp_path / "values.npz"
    for given, options, message in (
        (values, {"name": "mask"}, "name: got 'mask', which is the name of another array"),
        (values, {"extra": {"values": values}}, "name: got 'values', which is the name of another array"),
        (values, {"extra": {"fit": None}}, "fit: got Python objects for an npz"),
        (np.ma.array(values, mask=np.eye(4, 3)), {}, "values: got a masked array"),
        (values + 1j, {}, "values: got complex numbers"),
    ):
        with unchecked(), pytest.raises(ValueError, match=f"^{message}"):
            hj.io.save(path, given, volume, **options)
    assert not path.exists()


def test_results_and_volumes_take_lists_and_check_shapes(tmp_path):
    with unchecked():
        volume = hj.io.TensorVolume(np.broadcast_to(np.eye(2), (4, 3, 2, 2)).tolist(), 2, [0, 0])
        assert volume.spacing == (2.0, 2.0)
        assert volume.tensors.dtype == np.float64
        result = hj.io.Result(volume, np.ones((2, 4, 3)).tolist(), [1, 2], arrays={"bias": np.ones((2, 4, 3))})
        result.save(tmp_path / "hks", ".nii")
        assert set(hj.io.Result.read(tmp_path / "hks.npz").arrays) == {"bias", "input_tensors"}
        with pytest.raises(ValueError, match=r"values: got shape \(4, 3\) and times of shape \(1,\); expected"):
            hj.io.Result(volume, np.ones((4, 3)), [1])
        with pytest.raises(ValueError, match=r"modes: got shape \(4, 3, 3\)"):
            hj.io.TensorVolume(volume.tensors, (1, 1), (0, 0), modes=np.ones((4, 3, 3)))
        mask = hj.io.read_tensors(hj.io.save_tensors(tmp_path / "t.npz", volume), mask=[[1, 1, 0]] * 4).mask
        assert mask.sum() == 8


@pytest.mark.parametrize("axis", [None, 0, 1, 2])
def test_an_affine_gives_the_spacing_that_an_npz_lacks(tmp_path, axis):
    c, s = np.cos(0.3), np.sin(0.3)
    affine = np.diag([1.0, 1, 1, 1])
    affine[:3, :3] = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.diag([1.5, 2.0, 3.0])
    d, sizes = (3, [1.5, 2.0, 3.0]) if axis is None else (2, np.delete([1.5, 2.0, 3.0], axis))
    arrays = {"tensors": np.broadcast_to(np.eye(d), (*(5,) * d, d, d)), "affine": affine}
    arrays |= {} if axis is None else {"slice_axis": axis}
    np.savez(tmp_path / "t.npz", **arrays)
    np.testing.assert_allclose(hj.io.read_tensors(tmp_path / "t.npz").spacing, sizes)
    np.savez(tmp_path / "t.npz", **arrays, spacing=np.multiply(sizes, 1.01))
    with pytest.raises(ValueError, match=r"t\.npz: spacing: got .*, but the affine's voxels have the size \("):
        hj.io.read_tensors(tmp_path / "t.npz")
    np.savez(tmp_path / "t.npz", **arrays, spacing=np.multiply(sizes, 1 + 1e-6))  # rounded
    np.testing.assert_allclose(hj.io.read_tensors(tmp_path / "t.npz").spacing, sizes, rtol=1e-5)
