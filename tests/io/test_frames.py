"""Frames: along which axes tensors are, what a file says of it, and what the fibres themselves say."""

import json
from dataclasses import replace

import nibabel as nib
import numpy as np
import pytest
from dipy.core.gradients import gradient_table
from dipy.io.utils import nifti1_symmat
from dipy.reconst.dti import TensorModel, lower_triangular

from hks_jax.cli import main
from hks_jax.io import TensorVolume, fit_dwi, questions, read_tensors, save_tensors
from hks_jax.io.plausibility import coherence, undeclared_frame
from hks_jax.io.tensor_order import pack

SHAPE = (26, 24, 14)
SPACING = (2.0, 1.8, 2.5)
WRONG = "Wrong frame? Principal directions differ from the mean direction of their two neighbours along the fibre by "


def positions():
    return np.stack([(i - (n - 1) / 2) * h for i, n, h in zip(np.indices(SHAPE), SHAPE, SPACING, strict=True)], -1)


def along(v, noise=0.0):
    """Tensors in mm²/s with these principal directions."""
    v = v / np.linalg.norm(v, axis=-1, keepdims=True)
    v = v + noise * np.random.default_rng(0).normal(size=v.shape)
    v /= np.linalg.norm(v, axis=-1, keepdims=True)
    return 1e-3 * (0.4 * np.eye(3) + 1.2 * v[..., :, None] * v[..., None, :])


def bundles(noise=0.0):
    """Tensors along the voxel axes whose fibres are straight bundles of many directions, as thick as a few voxels."""
    rng = np.random.default_rng(4)
    directions = rng.normal(size=(100, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    apart = positions()[..., None, :] - rng.uniform(-0.5, 0.5, (100, 3)) * np.multiply(SHAPE, SPACING)
    across = apart - np.einsum("...na,na->...n", apart, directions)[..., None] * directions
    return along(directions[np.argmin(np.linalg.norm(across, axis=-1), axis=-1)], noise)


def affine(degrees=0.0, flip=False):
    a, b = np.radians(degrees), np.radians(degrees / 2)
    rz = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    rx = np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
    matrix = np.eye(4)
    matrix[:3, :3] = rz @ rx @ np.diag([-1.0 if flip else 1.0, 1, 1]) @ np.diag(SPACING)
    return matrix


def axes(matrix):
    return matrix[:3, :3] / np.linalg.norm(matrix[:3, :3], axis=0)


def write(path, tensors, matrix):
    image = nib.Nifti1Image(pack(tensors, "nifti")[..., None, :], matrix)
    image.header.set_intent("symmetric matrix", (3,))
    nib.save(image, path)
    return path


# ---------------------------------------------------------------------------------------------------- fibres


@pytest.mark.parametrize("noise", [0.0, 0.2])
@pytest.mark.parametrize("flip", [False, True])
def test_fibres_continue_best_along_the_right_axes(tmp_path, noise, flip):
    read = read_tensors(write(tmp_path / "t.nii.gz", bundles(noise), affine(30, flip)))
    found = coherence(read)
    # In an image with x reversed FSL's axes are the voxels' own; else they are those with x reversed.
    scanners = {f"scanner's {axis}" for axis in "xyz"}
    assert {a.name for a in found.others} == {"world", "y", "z", "x" if flip else "fsl", *scanners}
    assert all(a.errors < -5 and a.angle > found.angle + 1 for a in found.others)
    assert found.better is None
    assert questions(read) == ()  # though NIfTI leaves the frame open


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_reversed_axis_shows(tmp_path, axis):
    signs = np.where(np.arange(3) == axis, -1.0, 1.0)
    mirrored = bundles(0.1) * np.outer(signs, signs)
    (question,) = questions(read_tensors(write(tmp_path / "t.nii.gz", mirrored, affine(0, flip=True))))
    # In an image with x reversed, the scanner's axes are the voxels' with x reversed.
    wanted = 'along the world axes: try frame="world"' if axis == 0 else f"with the {'xyz'[axis]} axis reversed"
    assert question.startswith(WRONG)
    assert wanted in question


@pytest.mark.parametrize("degrees", [25, 40])
@pytest.mark.parametrize("flip", [False, True])
def test_scanner_axes_in_an_oblique_image_show(tmp_path, degrees, flip):
    turn = axes(affine(degrees, flip))
    world = turn @ bundles(0.1) @ turn.T
    path = write(tmp_path / "t.nii.gz", world, affine(degrees, flip))
    (question,) = questions(read_tensors(path))
    assert 'along the world axes: try frame="world"' in question
    told = read_tensors(path, frame="world")
    assert questions(told) == ()
    np.testing.assert_allclose(told.tensors, bundles(0.1), atol=1e-9)


@pytest.mark.parametrize("noise", [0.0, 0.1, 0.3])
@pytest.mark.parametrize("axis", [None, 0, 1, 2])
def test_smooth_fibres_that_bend_are_no_reason_to_ask(noise, axis):
    """Around a heart neighbours across the fibres are more alike than those along them."""
    x, y, _ = np.moveaxis(positions(), -1, 0)
    radius = np.hypot(x, y)
    turn = np.radians(60) * (radius / 15 - 1)
    ring = np.stack([-y / radius * np.cos(turn), x / radius * np.cos(turn), np.sin(turn)], -1)
    signs = np.where(np.arange(3) == (-1 if axis is None else axis), -1.0, 1.0)
    heart = TensorVolume(along(ring * signs, noise), SPACING, (0.0,) * 3, radius > 6, affine(), length_unit="mm")
    assert coherence(heart).better is None


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_measurement_frame_with_a_wrong_sign_shows(tmp_path, axis):
    nrrd = pytest.importorskip("nrrd")
    volume = TensorVolume(bundles(0.1), SPACING, (0.0,) * 3, affine=affine(35, True), length_unit="mm")
    data, header = nrrd.read(str(save_tensors(tmp_path / "t.nrrd", volume)))
    assert questions(read_tensors(tmp_path / "t.nrrd")) == ()
    header["measurement frame"][:, axis] *= -1  # a component of each of its vectors
    nrrd.write(str(tmp_path / "u.nrrd"), data, header)
    (question,) = questions(read_tensors(tmp_path / "u.nrrd"))
    assert f"along the measurement axes, but only by 23.2° with the scanner's {'xyz'[axis]} axis reversed" in question


def test_what_decides_nothing_is_no_question():
    matrix = affine()
    placed = {"affine": matrix, "length_unit": "mm"}
    straight = np.broadcast_to(1e-3 * np.diag([1.7, 0.3, 0.3]), (*SHAPE, 3, 3))
    anything = np.random.default_rng(2).normal(size=(*SHAPE, 3))
    anything = 1e-3 * (0.3 * np.eye(3) + anything[..., :, None] * anything[..., None, :])
    for tensors in (straight, anything, bundles()[:4, :4], np.broadcast_to(1e-3 * np.eye(3), (*SHAPE, 3, 3))):
        volume = TensorVolume(tensors, SPACING, (0.0,) * 3, **placed)
        assert questions(volume) == ()
        assert questions(replace(volume, notes=(undeclared_frame(),))) == (undeclared_frame(),)
    assert coherence(TensorVolume(bundles(), SPACING, (0.0,) * 3, **placed).slice("z", 2)) is None
    holes = bundles()
    holes[::2, 3] = np.nan
    holes[3] = 0
    assert coherence(TensorVolume(holes, SPACING, (0.0,) * 3, **placed)).better is None


# ---------------------------------------------------------------------------------------------------- DIPY's files


@pytest.fixture
def scan(tmp_path):
    """Images of the bundles in an affine of positive determinant, with FSL's b-vectors, and DIPY's fit as NIfTI."""
    directions = np.random.default_rng(0).normal(size=(13, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    b = np.array([0.0] + [1000.0] * 12)
    directions[0] = 0
    signal = 1000 * np.exp(-b * np.einsum("na,xyzab,nb->xyzn", directions, bundles(), directions))
    nib.save(nib.Nifti1Image(signal, affine()), tmp_path / "d.nii.gz")
    np.savetxt(tmp_path / "b", b[None])
    fsl = directions * [-1, 1, 1]
    np.savetxt(tmp_path / "g", fsl.T)
    fit = TensorModel(gradient_table(b, bvecs=fsl)).fit(signal)
    nib.save(nifti1_symmat(lower_triangular(fit.quadratic_form), affine()), tmp_path / "dipy.nii.gz")
    return tmp_path


def test_the_mirrored_tensors_of_dipy_are_noticed(scan, capsys):
    path = str(scan / "dipy.nii.gz")
    (question,) = questions(read_tensors(path))
    assert 'along the fsl axes: try frame="fsl"' in question
    assert questions(read_tensors(path, frame="fsl")) == ()
    np.testing.assert_allclose(read_tensors(path, frame="fsl").tensors, bundles(), atol=2e-8)
    assert main(["convert", path, str(scan / "o.nii.gz"), "-q"]) == 0
    assert "axes: try --frame fsl\n" in capsys.readouterr().err
    assert main(["info", path]) == 0
    printed = capsys.readouterr()
    assert "question        Wrong frame?" in printed.out
    assert printed.err == ""


def test_gradient_directions_along_other_axes(scan, tmp_path, capsys):
    names = scan / "d.nii.gz", scan / "b", scan / "g"
    everywhere = np.ones(SHAPE, bool)
    right = fit_dwi(*names, everywhere)
    np.testing.assert_allclose(right.tensors, bundles(), atol=2e-8)
    assert questions(right) == ()
    (question,) = questions(fit_dwi(*names, everywhere, bvec_frame="voxel"))
    assert 'along the fsl axes: try bvec_frame="fsl"' in question
    np.savetxt(scan / "voxel", np.loadtxt(scan / "g") * [[-1], [1], [1]])
    np.testing.assert_allclose(
        fit_dwi(*names[:2], scan / "voxel", everywhere, bvec_frame="voxel").tensors, right.tensors, atol=1e-9
    )
    # Along the scanner's axes, in an oblique image.
    image, matrix = nib.load(names[0]), affine(35, flip=True)
    nib.save(nib.Nifti1Image(image.get_fdata(), matrix), scan / "oblique.nii.gz")
    np.savetxt(scan / "world", axes(matrix) @ np.loadtxt(scan / "voxel"))
    world = fit_dwi(scan / "oblique.nii.gz", names[1], scan / "world", everywhere, bvec_frame="world")
    np.testing.assert_allclose(world.tensors, right.tensors, atol=1e-9)
    assert world.frame == "world"
    assert "gradient directions read along the world axes; tensors transformed to the voxel axes" in world.notes
    # On the command line.
    np.save(scan / "m.npy", everywhere)
    arguments = ["--mask", str(scan / "m.npy"), "--bval", str(names[1]), "--bvec"]
    out = str(tmp_path / "out.nii.gz")
    wrong = ["convert", str(names[0]), out, *arguments, str(names[2]), "-q", "--bvec-frame", "voxel"]
    assert main(wrong) == 0
    assert "along the fsl axes: try --bvec-frame fsl\n" in capsys.readouterr().err
    assert main([*wrong[:-2], "--frame", "voxel"]) == 2
    assert "--frame: this option is for files of tensors; pass --bvec-frame" in capsys.readouterr().err
    assert main(["info", out, "--bvec-frame", "fsl"]) == 2
    assert "images; for tensors pass --frame" in capsys.readouterr().err


# ---------------------------------------------------------------------------------------------------- own files


def test_own_files_say_along_which_axes_they_are(scan, capsys):
    out = scan / "own.nii.gz"
    assert main(["convert", str(scan / "dipy.nii.gz"), str(out), "--frame", "fsl", "-q"]) == 0
    capsys.readouterr()
    own = read_tensors(out)
    np.testing.assert_allclose(own.tensors, bundles(), atol=2e-8)
    assert undeclared_frame() not in own.notes
    assert own.frame == "voxel"
    record = json.loads(nib.load(out).header.extensions[0].get_content())
    assert [record[key] for key in ("order", "frame", "source_order", "source_frame")] == [
        "nifti",
        "voxel",
        "nifti",
        "fsl",
    ]
    assert main(["info", str(out)]) == 0
    printed = capsys.readouterr().out
    angle = coherence(own).angle
    assert "The axes of the tensors seem right. Principal directions differ" in printed
    said = f"by {angle:.1f}° on average; the angle is clearly larger along the fsl axes, or with y, z reversed\n"
    assert said in printed
    assert "--frame" not in printed
    # Whoever mirrors it nevertheless is told.
    assert main(["info", str(out), "--frame", "fsl"]) == 0
    printed = capsys.readouterr().out
    assert "components read along the fsl axes, as asked; the file declares the voxel axes" in printed
    assert "try --frame voxel" in printed
    for name, frame in (("own.nrrd", "measurement"), ("own.npz", "voxel")):
        written = read_tensors(save_tensors(scan / name, own))
        np.testing.assert_allclose(written.tensors, bundles(), atol=2e-8)
        assert written.frame == frame
    with np.load(scan / "own.npz") as arrays:
        assert (str(arrays["frame"]), json.loads(str(arrays["provenance"]))["frame"]) == ("voxel", "voxel")


def test_the_record_of_an_image_that_was_turned_since_is_not_believed(tmp_path):
    volume = TensorVolume(bundles(), SPACING, (0.0,) * 3, affine=affine(), length_unit="mm")
    image = nib.load(save_tensors(tmp_path / "t.nii.gz", volume))
    assert undeclared_frame() not in read_tensors(tmp_path / "t.nii.gz").notes
    moved = nib.Nifti1Image(image.get_fdata(), image.affine, image.header)
    nib.save(moved, tmp_path / "copy.nii.gz")  # by nibabel, which keeps the record
    assert undeclared_frame() not in read_tensors(tmp_path / "copy.nii.gz").notes
    nib.save(image.as_reoriented(np.array([[0, -1], [1, -1], [2, 1]])), tmp_path / "turned.nii.gz")
    assert undeclared_frame() in read_tensors(tmp_path / "turned.nii.gz").notes


@pytest.mark.parametrize(
    ("reference", "frame"), [("scanner", "world"), ("xyz", "world"), ("ijk", "voxel"), ("bvec", "fsl")]
)
def test_a_sidecar_says_the_axes_of_one_image(tmp_path, reference, frame):
    path = write(tmp_path / "sub-01_dwimap.nii.gz", bundles(), affine(40))
    (tmp_path / "sub-01_dwimap.json").write_text(json.dumps({"OrientationEncoding": {"Reference": reference}}))
    read = read_tensors(path)
    assert read.frame == frame
    assert undeclared_frame() not in read.notes
    np.testing.assert_array_equal(read.tensors, read_tensors(path, frame=frame).tensors)
    # A file that `save_tensors` writes beside an old sidecar is along the voxel axes.
    own = read_tensors(save_tensors(path, read))
    np.testing.assert_allclose(own.tensors, read.tensors, rtol=1e-6, atol=1e-12)
    assert own.frame == "voxel"
    assert any("of the sidecar are ignored" in note for note in own.notes) == (frame != "voxel")


def test_a_sidecar_says_the_order_of_a_tensor(tmp_path):
    nib.save(nib.Nifti1Image(pack(bundles(), "fsl"), affine(40)), tmp_path / "t.nii.gz")
    encoding = {"Type": "tensor", "TensorRank": 2, "Reference": "ijk", "EncodingAxis": 3}
    (tmp_path / "t.json").write_text(json.dumps({"OrientationEncoding": encoding}))
    read = read_tensors(tmp_path / "t.nii.gz")
    np.testing.assert_allclose(read.tensors, bundles(), rtol=1e-12, atol=1e-18)
    (tmp_path / "t.json").write_text(json.dumps({"OrientationEncoding": {**encoding, "Reference": "RAS"}}))
    with pytest.raises(ValueError, match=r"t\.json: got the Reference 'RAS'; expected one of ijk, bvec, xyz, scanner"):
        read_tensors(tmp_path / "t.nii.gz")
    (tmp_path / "t.json").write_text(json.dumps({"OrientationEncoding": {**encoding, "Reference": ["ijk"]}}))
    with pytest.raises(ValueError, match="got the Reference"):
        read_tensors(tmp_path / "t.nii.gz")
    for text in ("[1, 2]", '{"OrientationEncoding": null}', '{"RepetitionTime": 2.0}'):
        (tmp_path / "t.json").write_text(text)
        with pytest.raises(ValueError, match="does not declare their order"):
            read_tensors(tmp_path / "t.nii.gz")
