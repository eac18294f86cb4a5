"""Tensors that are not positive definite: refused with the choices, or mended and reported."""

import json
from dataclasses import replace

import numpy as np
import pytest
from annotations import unchecked

import hks_jax as hj
from hks_jax.cli import main
from hks_jax.io import TensorVolume, find_invalid, read_tensors, repair_tensors
from hks_jax.io.repair import least_admissible, positive_tensors, require_valid

SHAPE = (8, 9)
BAD = [(2, 3), (4, 1)]


@pytest.fixture
def volume():
    """Diffusion tensors 1e-3·diag(1, 2), two of them with a negative eigenvalue along a rotated axis."""
    tensors = np.broadcast_to(1e-3 * np.diag([1.0, 2.0]), (*SHAPE, 2, 2)).copy()
    c, s = np.cos(0.4), np.sin(0.4)
    turn = np.array([[c, -s], [s, c]])
    for node in BAD:
        tensors[node] = turn @ np.diag([-4e-4, 1.5e-3]) @ turn.T
    mask = np.ones(SHAPE, bool)
    mask[0] = False
    return TensorVolume(tensors, (1.0, 1.0), (0.0, 0.0), mask)


def test_the_refusal_counts_and_names_the_choices(volume):
    with pytest.raises(ValueError, match=r"2 of 63 tensors are not positive definite, worst eigenvalue -0\.0004"):
        require_valid(volume)
    with pytest.raises(
        ValueError, match=r'first at voxel \(2, 3\)\); expected .*\. Choose repair: "clip".*"mask".*"nearest"'
    ):
        require_valid(volume)
    volume.tensors[BAD[0]] = np.nan
    with pytest.raises(ValueError, match="1 of them NaN or infinite"):
        require_valid(volume)
    with pytest.raises(ValueError, match="repair_tensors"):
        hj.TensorField(volume.with_mask(np.arange(8)[:, None] + np.zeros(9) > 2).grid(), volume.tensors)


def test_clip_is_the_nearest_tensor_with_this_floor(volume):
    mended = repair_tensors(volume, "clip", 1e-4)
    values, vectors = np.linalg.eigh(mended.tensors[BAD[0]])
    np.testing.assert_allclose(values, [1e-4, 1.5e-3])
    np.testing.assert_allclose(np.abs(vectors[:, 0]), [np.cos(0.4), np.sin(0.4)])  # axes stay
    untouched = np.ones(SHAPE, bool)
    untouched[tuple(zip(*BAD, strict=True))] = False
    np.testing.assert_array_equal(mended.tensors[untouched], volume.tensors[untouched])
    assert not find_invalid(mended).any()
    # No tensor with eigenvalues ≥ 1e-4 is nearer in the Frobenius norm.
    distance = np.linalg.norm(mended.tensors[BAD[0]] - volume.tensors[BAD[0]])
    for root in np.random.default_rng(0).normal(size=(200, 2, 2)):
        other = mended.tensors[BAD[0]] + 1e-4 * (root @ root.T - 0.1 * np.eye(2))
        if np.linalg.eigvalsh(other)[0] >= 1e-4:
            assert np.linalg.norm(other - volume.tensors[BAD[0]]) >= distance
    # Without a floor it is a hundredth of what is typical.
    assert np.linalg.eigvalsh(repair_tensors(volume, "clip").tensors[BAD[0]])[0] == pytest.approx(1.5e-5)


def test_mask_and_nearest(volume):
    masked = repair_tensors(volume, "mask")
    assert masked.inside.sum() == 61
    assert not masked.inside[BAD[0]]
    volume.tensors[2, 4] = 1e-3 * np.diag([5.0, 6.0])
    volume.tensors[2, 2] = np.nan
    far = TensorVolume(volume.tensors, (3.0, 1.0), (0.0, 0.0), volume.mask)
    np.testing.assert_array_equal(repair_tensors(far, "nearest").tensors[2, 3], volume.tensors[2, 4])
    assert not find_invalid(repair_tensors(far, "nearest")).any()
    with pytest.raises(
        ValueError, match=r'NaN or infinite and have no eigenvalues to clip\. Choose "mask" or "nearest"'
    ):
        repair_tensors(far, "clip")


def test_the_report(volume):
    mended = repair_tensors(volume, "clip", 1e-4)
    assert mended.repair == {
        "method": "clip",
        "floor": 1e-4,
        "voxels": 2,
        "of": 63,
        "not_finite": 0,
        "worst_eigenvalue": pytest.approx(-4e-4),
        "box": [[2, 1], [4, 3]],
        "first": [[2, 3], [4, 1]],
    }
    assert "2 of 63 tensors have an eigenvalue below 0.0001 (the worst eigenvalue is -0.0004)" in mended.notes[-1]
    assert "raises eigenvalues of invalid tensors to 0.0001" in mended.notes[-1]
    sound = repair_tensors(mended, "mask")
    assert (sound.repair["voxels"], sound.notes) == (0, mended.notes)
    np.testing.assert_array_equal(sound.inside, volume.inside)


def test_a_floor_counts_small_eigenvalues_too(volume):
    volume.tensors[5, 5] = 1e-3 * np.diag([0.01, 2.0])
    assert repair_tensors(volume, "mask").repair["voxels"] == 2
    assert repair_tensors(volume, "mask", 1e-4).repair["voxels"] == 3


def test_background_is_left_out_and_reading_repairs(tmp_path, volume):
    volume.tensors[0] = 0
    np.savez(tmp_path / "t.npz", tensors=volume.tensors)
    read = read_tensors(tmp_path / "t.npz", repair="nearest")
    assert (read.repair["voxels"], read.repair["of"]) == (2, 63)
    np.testing.assert_array_equal(read.inside, volume.inside)
    np.testing.assert_array_equal(read_tensors(tmp_path / "t.npz").tensors, volume.tensors)


def test_bad_repairs(volume):
    with unchecked(), pytest.raises(ValueError, match="repair: got 'abs'; expected 'clip', 'mask', 'nearest'"):
        repair_tensors(volume, "abs")
    with pytest.raises(ValueError, match="floor: got -1; expected a finite number above 0"):
        repair_tensors(volume, "clip", -1)
    hopeless = TensorVolume(-volume.tensors, (1.0, 1.0), (0.0, 0.0), volume.mask & (np.indices(SHAPE)[0] > 4))
    with pytest.raises(ValueError, match=r"all 27 tensors are not positive definite\. Noise does not explain"):
        repair_tensors(hopeless, "clip")
    with pytest.raises(ValueError, match=r"all 63 tensors have an eigenvalue below 1\. Choose a lower floor"):
        repair_tensors(volume, "clip", 1)


def test_the_command_line_refuses(tmp_path, volume, capsys):
    np.savez(tmp_path / "t.npz", tensors=volume.tensors, mask=volume.mask)
    arguments = ["hks", str(tmp_path / "t.npz"), "-o", str(tmp_path / "out"), "-q", "-k", "5", "--times", "1"]
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert "2 of 63 tensors are not positive definite" in error
    assert 'Choose --repair: "clip" (raise eigenvalues to a floor), "mask"' in error
    assert main([*arguments, "--repair", "abs"]) == 2
    assert "such as clip:1e-4" in capsys.readouterr().err


# ------------------------------------------------------------------------------------------------ nearly singular


def tissue(**units):
    """A volume in mm: white matter, grey matter and CSF, and one voxel whose fit DIPY clipped."""
    i = np.indices((10, 9, 4))[0]
    values = np.select(
        [i[..., None] < 4, i[..., None] < 8], [[1.7e-3, 2.5e-4, 1.5e-4], [9e-4, 8e-4, 7e-4]], [3e-3, 3e-3, 2.9e-3]
    )
    tensors = values[..., None] * np.eye(3)
    tensors[1, 2, 3] = np.diag([8e-4, 6e-4, 1.08e-9])
    return TensorVolume(
        tensors, (2.0, 2.0, 2.0), (0.0,) * 3, affine=np.diag([2.0, 2, 2, 1]), **{"length_unit": "mm", **units}
    )


@pytest.mark.parametrize("unit", ["", "mm²/s"])
def test_nearly_singular_diffusion_tensors_are_refused_asked_about_and_mended(unit):
    volume = tissue(unit=unit)
    found = find_invalid(volume)
    assert np.argwhere(found).tolist() == [[1, 2, 3]]
    words = rf"1 of 360 tensors are nearly singular, with an eigenvalue below 8e-06{f' {unit}' * bool(unit)}, worst"
    with pytest.raises(
        ValueError, match=rf"{words} eigenvalue 1\.08e-09 \(the first at voxel \(1, 2, 3\)\).*clip:1e-12"
    ):
        require_valid(volume)
    (question,) = hj.io.questions(volume)
    assert question.startswith("Nearly singular? 1 of 360 tensors are nearly singular")
    for method in ("nearest", "mask", "clip"):
        mended = repair_tensors(volume, method)  # without a floor
        require_valid(mended)
        assert (mended.repair["voxels"], mended.repair["first"]) == (1, [[1, 2, 3]])
        assert (
            "have an eigenvalue below 8e-06 (the worst eigenvalue is 1.08e-09), the first at voxel (1, 2, 3)"
            in (mended.notes[-1])
        )
        assert hj.io.questions(mended) == ()
    require_valid(repair_tensors(volume, "clip", 1e-12))  # as asked
    assert np.linalg.eigvalsh(repair_tensors(volume, "clip").tensors[1, 2, 3])[0] == pytest.approx(8e-6)
    require_valid(repair_tensors(replace(volume, tensors=volume.tensors.astype(np.float32)), "clip", 1e-9))


@pytest.mark.parametrize("method", ["clip", "mask", "nearest"])
def test_repaired_tensors_are_valid_in_the_file_to_which_they_are_written(tmp_path, method, rng):
    """Rounding to float32 and the median after the repair make no tensor invalid that the repair left or made."""
    turns = np.linalg.qr(rng.normal(size=(10, 9, 4, 3, 3)))[0]
    values = rng.uniform(1e-4, 2e-3, (10, 9, 4, 1)) * rng.uniform(0.5, 1, (10, 9, 4, 3))
    wrong = rng.uniform(size=(10, 9, 4)) < 0.2
    values[wrong, 0] = rng.uniform(-1e-4, 1e-5, wrong.sum())
    values[wrong, 2] *= 20  # the largest mean eigenvalues, so the median falls without these tensors
    tensors = (turns * values[..., None, :]) @ np.swapaxes(turns, -1, -2)
    tensors = (tensors + np.swapaxes(tensors, -1, -2)) / 2
    about = {"length_unit": "mm", "unit": "mm²/s"}
    with pytest.warns(hj.AccuracyWarning, match="depends strongly on the repair"):
        mended = repair_tensors(TensorVolume(tensors, (2.0,) * 3, (0.0,) * 3, **about), method)
    assert mended.repair["voxels"] > 50
    saved = replace(mended, tensors=mended.tensors.astype(np.float32))
    again = read_tensors(hj.io.save_tensors(tmp_path / "t.npz", saved))
    assert least_admissible(again) > 0
    assert not find_invalid(again).any()
    if method == "clip":
        least = np.linalg.eigvalsh(mended.tensors[wrong])[:, 0].min()
        assert least == pytest.approx(mended.repair["floor"])
        assert least >= least_admissible(again)


def test_what_tissue_phantoms_and_metrics_have_is_no_false_alarm():
    whole = tissue()
    sound = replace(whole, tensors=np.where(find_invalid(whole)[..., None, None], 8e-4 * np.eye(3), whole.tensors))
    sticks = np.broadcast_to(np.diag([1.7e-3, 1e-5, 1e-5]), sound.tensors.shape)
    metric = np.broadcast_to(np.diag([1.0, 1.0, 1e-6]), sound.tensors.shape).copy()
    metric[0] = np.eye(3)
    for volume in (
        sound,
        replace(sound, tensors=0.2 * sound.tensors, unit="mm²/s"),  # fixed tissue beside its fluid
        replace(sound, tensors=sticks, unit="mm²/s"),  # simulated sticks, FA 0.99
        replace(sound, tensors=metric),  # a metric in an image: its eigenvalues are not diffusivities
        replace(whole, length_unit=""),  # no unit at all
        positive_tensors(replace(whole, tensors=1e9 * whole.tensors), "exp", 2e5),  # exp of stresses
    ):
        require_valid(volume)
        assert not [text for text in hj.io.questions(volume) if "singular" in text]
    assert least_admissible(replace(sound, tensors=1e-9 * sound.tensors, unit="mm²/s")) == pytest.approx(1e-7)


def test_commands_refuse_and_mend_nearly_singular_tensors(tmp_path, capsys):
    pytest.importorskip("nibabel")
    volume = tissue()
    path = str(hj.io.save_tensors(tmp_path / "t.nii.gz", volume))
    assert main(["info", path]) == 0
    text = capsys.readouterr().out
    assert "1 tensors are nearly singular, with an eigenvalue below 8e-06, a hundredth" in text
    assert main(["info", path, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["not_positive_definite"], found["nearly_singular"]) == (0, 1)
    times = found["suits"]["inverse"]
    assert main(["info", path, "--json", "--repair", "nearest"]) == 0
    mended = json.loads(capsys.readouterr().out)
    assert mended["nearly_singular"] == 0
    assert times["least_time_of_k"] == pytest.approx(mended["suits"]["inverse"]["least_time_of_k"], rel=0.1)
    arguments = ["hks", path, "-o", str(tmp_path / "out"), "--metric", "inverse"]
    assert main([*arguments, "-q"]) == 2
    assert "1 of 360 tensors are nearly singular" in (error := capsys.readouterr().err)
    assert 'Choose --repair: "clip"' in error
    assert main(["convert", path, str(tmp_path / "s.nii.gz")]) == 0
    assert "warning: 1 tensors are nearly singular, with" in capsys.readouterr().err
    np.savez(tmp_path / "hks.npz", hks=np.ones((1, 10, 9, 4)), times=[1.0], spacing=[2.0] * 3, origin=[0.0] * 3)
    arguments = ["fit", str(tmp_path / "hks.npz"), "-o", str(tmp_path / "f"), "--init", path, "--metric", "inverse"]
    assert main(arguments) == 2
    assert "--init: 1 of 360 tensors are nearly singular" in (error := capsys.readouterr().err)
    assert "hks-jax convert" in error


# ---------------------------------------------------------------------------------------------------- stress


def test_a_stress_of_zero_is_inside(tmp_path, capsys):
    """exp(0) = I is as good as any; only diffusion tensors are zero in the background."""
    stress = np.zeros((12, 10, 2, 2))
    x, y = (a / 11 for a in np.indices((12, 10)))
    stress[..., 0, 0], stress[..., 1, 1], stress[..., 0, 1] = 1e6 * x, -1e6 * y, 2e5 * x * y
    stress[..., 1, 0] = stress[..., 0, 1]
    stress[6, 5] = 0
    volume = TensorVolume(stress, (0.1, 0.1), (0.0, 0.0))
    mapped = positive_tensors(volume, "exp", 2e6)
    assert mapped.mask is None
    np.testing.assert_array_equal(mapped.tensors[6, 5], np.eye(2))
    np.savez(tmp_path / "s.npz", tensors=stress, spacing=[0.1, 0.1])
    arguments = [str(tmp_path / "s.npz"), "--positive", "exp:2e6"]
    assert main(["hks", *arguments, "-o", str(tmp_path / "out"), "-k", "6", "--times", "0.1"]) == 0
    said = capsys.readouterr().err
    assert "outside" not in said
    assert json.loads((tmp_path / "out" / "report.json").read_text())["settings"]["boundary"] == "neumann"
    assert np.isfinite(np.load(tmp_path / "out" / "hks.npz")["hks"]).all()
    stress[8:] = 0  # probably a background, which a warning names
    np.savez(tmp_path / "s.npz", tensors=stress, spacing=[0.1, 0.1])
    assert main(["info", *arguments, "--json"]) == 0
    captured = capsys.readouterr()
    assert json.loads(captured.out)["inside"] == 120
    assert "42 of 120 voxels have tensors near zero, probably background, and count as inside. Pass" in captured.err
    assert main(["info", *arguments, "--json", "--background", "outside"]) == 0
    captured = capsys.readouterr()
    assert json.loads(captured.out)["inside"] == 78
    assert captured.err == ""
    assert main(["info", *arguments, "--json", "--background", "inside"]) == 0
    assert capsys.readouterr().err == ""
