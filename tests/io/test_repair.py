"""Tensors that are not positive definite: refused with the choices, or mended and reported."""

import numpy as np
import pytest
from annotations import unchecked

import hks_jax as hj
from hks_jax.cli import main
from hks_jax.io import TensorVolume, find_invalid, read_tensors, repair_tensors
from hks_jax.io.repair import require_valid

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
