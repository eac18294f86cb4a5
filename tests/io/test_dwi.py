"""Scans as they come: signals and directions that are not numbers, b-values in other units."""

import jax
import jax.numpy as jnp
import nibabel as nib
import numpy as np
import pytest

import hks_jax as hj
from hks_jax.cli import main
from hks_jax.io import fit_dwi

SHAPE = (24, 22, 6)
D = 1e-3 * np.array([[1.5, 0.2, 0.1], [0.2, 0.8, 0.0], [0.1, 0.0, 0.6]])
FSL = np.outer([-1, 1, 1], [-1, 1, 1])
"""What D becomes along the voxel axes where the affine keeps orientation and directions are FSL's."""


def head():
    i, j, _ = (2 * a / (n - 1) - 1 for a, n in zip(np.indices(SHAPE), SHAPE, strict=True))
    return i**2 + j**2 < 0.6


class Scan:
    """A noise-free scan of D in a head, whose files can be written with what is wrong in scans."""

    def __init__(self, folder):
        self.folder = folder
        directions = np.random.default_rng(0).normal(size=(14, 3))
        self.directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        self.b = np.array([0.0, 0.0] + [1000.0] * 12)
        self.directions[:2] = 0
        exponent = self.b * np.einsum("na,ab,nb->n", self.directions, D, self.directions)
        self.signal = np.where(head()[..., None], 1000 * np.exp(-exponent), 5.0)

    def write(self):
        nib.save(nib.Nifti1Image(self.signal, np.diag([2.0, 2.0, 2.0, 1.0])), self.folder / "d.nii.gz")
        np.savetxt(self.folder / "b", self.b[None])
        np.savetxt(self.folder / "g", self.directions.T)
        return [self.folder / name for name in ("d.nii.gz", "b", "g")]

    def fit(self, *mask, **options):
        return fit_dwi(*self.write(), *mask, **options)


@pytest.fixture
def scan(tmp_path):
    return Scan(tmp_path)


def test_voxels_without_a_finite_signal_are_left_out(scan):
    lost = np.zeros(SHAPE, bool)
    lost[10, 9, 2] = lost[12, 9:11, 3] = True
    scan.signal[10, 9, 2, 5] = np.nan
    scan.signal[12, 9:11, 3, :] = np.inf
    scan.signal[0, 0, 0, :] = np.nan  # outside
    fit = scan.fit(head())
    np.testing.assert_array_equal(fit.mask, head() & ~lost)
    np.testing.assert_allclose(fit.tensors[fit.mask], np.broadcast_to(D * FSL, (fit.mask.sum(), 3, 3)), atol=1e-8)
    assert not fit.tensors[~fit.mask].any()
    assert f"3 of {head().sum()} voxels inside are left out: a signal there is NaN or infinite" in fit.notes


def test_a_background_of_nan_is_outside(scan):
    expected = scan.fit().mask
    scan.signal[~head()] = np.nan
    fit = scan.fit()
    assert fit.mask.sum() > 600
    np.testing.assert_array_equal(fit.mask, expected)
    np.testing.assert_allclose(fit.tensors[fit.mask], np.broadcast_to(D * FSL, (fit.mask.sum(), 3, 3)), atol=1e-8)


def test_an_image_without_signal_is_named(scan):
    scan.signal[..., 7] = np.nan
    with pytest.raises(ValueError, match=r"d\.nii\.gz: the used images 7 \(from 0\) have no finite signal inside"):
        scan.fit(head())


@pytest.mark.parametrize("value", [np.nan, 0.3, 7.0])
def test_directions_of_unweighted_images_mean_nothing(scan, value):
    expected = scan.fit(head()).tensors
    scan.directions[:2] = value
    np.testing.assert_array_equal(scan.fit(head()).tensors, expected)


@pytest.mark.parametrize(("value", "length"), [(np.nan, "nan"), (0.0, "0"), (0.4, "0.6928")])
def test_directions_of_another_length_are_refused_by_name(scan, value, length):
    scan.directions[5] = value
    with pytest.raises(ValueError, match=rf"[/\\]g: got 1 directions of .* the first for image 5 .*length {length};"):
        scan.fit(head())
    scan.b[5] = 3000.0  # an image that is left out
    assert scan.fit(head(), b_max=1000).mask.sum() == head().sum()


def test_rounded_directions_are_divided_by_their_lengths(scan):
    expected = scan.fit(head()).tensors
    scan.directions[2:] *= np.linspace(0.97, 1.03, 12)[:, None]
    fit = scan.fit(head())
    np.testing.assert_allclose(fit.tensors, expected, atol=1e-9)
    assert "12 directions were divided by their lengths, 0.97 to 1.03" in fit.notes


@pytest.mark.parametrize(("unit", "scale"), [("m2/s", 1e6), ("um2/ms", 1e-3)])
def test_b_values_in_another_unit_are_refused_until_it_is_told(scan, capsys, unit, scale):
    expected = scan.fit(head())
    scan.b *= scale
    with pytest.raises(
        ValueError, match=rf'[/\\]b: the largest b-value is .* the largest is 1000 s/mm².*pass unit "{unit}"'
    ):
        scan.fit(head())
    told = scan.fit(head(), unit=unit, b_max=1200)
    np.testing.assert_allclose(told.tensors, expected.tensors, atol=1e-12)
    assert told.notes[0] == "weighted least-squares fit to 14 of 14 images (b ≤ 1000 s/mm²)"
    assert told.unit == "mm²/s"
    images, b, g = map(str, scan.write())
    arguments = ["info", images, "--bval", b, "--bvec", g]
    assert main(arguments) == 2
    assert f"in 1/({unit}), the largest is 1000 s/mm²: pass --unit {unit}\n" in capsys.readouterr().err
    assert main([*arguments, "--unit", unit]) == 0
    assert "(b ≤ 1000 s/mm²)" in capsys.readouterr().out


def noisy_scan(scan, images, rng, sigma=10.0):
    """Let every voxel of the head be another measurement of the same tensor."""
    directions = rng.normal(size=(images, 3))
    scan.directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    scan.b = np.where(np.arange(images) < 2, 0.0, 1000.0)
    exponent = scan.b * np.einsum("na,ab,nb->n", scan.directions, D, scan.directions)
    scan.directions[:2] = 0
    scan.signal = 1000 * np.exp(-exponent) + sigma * rng.standard_normal((*SHAPE, images))
    return sigma


def lower(tensors):
    rows, columns = np.tril_indices(3)
    return tensors[..., rows, columns]


@pytest.mark.parametrize("frame", ["fsl", "world"])
def test_covariances_are_those_of_repeated_scans(scan, rng, frame):
    sigma = noisy_scan(scan, 20, rng)
    affine = np.eye(4)
    affine[:3, :3] = 2 * np.linalg.qr(rng.standard_normal((3, 3)))[0]
    paths, whole = scan.write(), np.ones(SHAPE, bool)
    nib.save(nib.Nifti1Image(scan.signal, affine), paths[0])
    stated, found = (fit_dwi(*paths, whole, bvec_frame=frame, noise=noise) for noise in (sigma, "residuals"))
    expected = np.cov(lower(stated.tensors[whole]).T)
    assert stated.modes is None
    # Nodes share nothing here, and residuals of images tell the same covariance as those of a voxel.
    by_image = np.einsum("...na,...nb->...ab", found.modes, found.modes)
    for covariance in (stated.covariance, found.covariance, by_image):
        mean = covariance[whole].mean(axis=0)
        np.testing.assert_allclose(mean, expected, atol=0.08 * np.abs(expected).max())
    assert "computed from the fit's residuals, with 13 degrees of freedom" in " ".join(found.notes)
    plane = found.slice("y", 10)
    np.testing.assert_array_equal(plane.covariance, found.covariance[:, 10][..., [0, 3, 5], :][..., [0, 3, 5]])
    noise = plane.noise(plane.grid())
    expected = by_image[:, 10][..., [0, 3, 5], :][..., [0, 3, 5]]
    np.testing.assert_allclose(noise.covariance, expected, rtol=1e-4, atol=1e-6 * expected.max())
    assert noise.freedom == 13


def test_what_voxels_share_of_an_images_noise_is_found(scan, rng):
    noisy_scan(scan, 60, rng)
    drift = 0.02  # the deviation of the brightness of whole images
    scan.signal *= 1 + drift * rng.standard_normal(60)
    found = scan.fit(head(), noise="residuals")
    apart = [1, 3, 4]  # xy xz yz, which the two images without weighting hardly change
    variance = np.sum(np.square(found.modes[head()].mean(axis=0)[:, apart]))  # of the mean tensor over the head
    g, b = scan.directions, scan.b
    rows, columns = np.tril_indices(3)
    X = np.column_stack([-b[:, None] * g[:, rows] * g[:, columns] * np.where(rows == columns, 1, 2), np.ones(60)])
    W = np.exp(-2 * b * np.einsum("na,ab,nb->n", g, D, g))
    pull = np.linalg.solve(X.T * W @ X, X.T * W)[apart]
    assert 0.6 < variance / np.sum(drift**2 * pull**2) < 1.6
    alone = found.covariance[head()].mean(axis=0)[apart, apart].sum() / head().sum()
    assert variance > 20 * alone  # as many voxels would have it, did they share nothing


def test_covariances_agree_with_the_wild_bootstrap(scan, rng):
    # Residuals of random sign, scaled by what the fit takes of them (Whitcher, Tuch, Wisco, Sorensen and Wang 2008).
    noisy_scan(scan, 40, rng)
    found = scan.fit(head(), noise="residuals")
    from dipy.core.gradients import gradient_table
    from dipy.reconst import dti

    table = gradient_table(scan.b, bvecs=scan.directions)
    X, voxels = dti.design_matrix(table), np.argwhere(head())[:30]
    ratios = []
    for voxel in map(tuple, voxels):
        y = np.log(scan.signal[voxel])
        w = np.exp(X @ np.linalg.pinv(X) @ y)
        fitted = X @ np.linalg.lstsq(X * w[:, None], w * y, rcond=None)[0]
        hat = (X * w[:, None]) @ np.linalg.pinv(X * w[:, None])
        scaled = (y - fitted) / np.sqrt(1 - np.diag(hat))
        again = np.exp(fitted + scaled * rng.choice([-1, 1], (150, 40)))
        spread = np.var(lower(dti.TensorModel(table).fit(again).quadratic_form), axis=0)
        ratios.append(spread / np.diag(found.covariance[voxel]))
    assert abs(np.mean(ratios) - 1) < 0.1


@pytest.mark.slow
def test_the_error_of_anisotropy_is_that_of_koay(scan, rng):
    noisy_scan(scan, 30, rng)
    fit = scan.fit(head(), noise="residuals")

    def anisotropy(tensors):
        deviator = tensors - jnp.trace(tensors) / 3 * np.eye(3)
        return jnp.sqrt(1.5 * jnp.sum(deviator**2) / jnp.sum(tensors**2))

    T, covariance = fit.tensors[12, 11, 3], fit.covariance[12, 11, 3]
    bars = hj.uncertainty(lambda tensors: anisotropy(tensors[0]), T[None], hj.TensorNoise(covariance[None]))
    # Koay, Chang, Pierpaoli and Basser 2007: FA² = 3/2 (1 − (tr D)²/3|D|²); off the diagonal a component counts twice.
    trace, square = np.trace(T), np.sum(T**2)
    slope = (T * trace**2 / square - trace * np.eye(3)) / (2 * square * float(anisotropy(T)))
    g = lower(slope) * np.where(np.equal(*np.tril_indices(3)), 1, 2)
    assert bars.method == "exact"
    np.testing.assert_allclose(bars.deviation, np.sqrt(g @ covariance @ g), rtol=1e-8)
    spread = np.std(jax.vmap(anisotropy)(jnp.asarray(fit.tensors[head()][:300])))
    assert abs(spread / bars.deviation - 1) < 0.35


def test_noise_needs_residuals(scan):
    with pytest.raises(
        ValueError, match=rf'noise: got "residuals", which are zero in {head().sum()} of {head().sum()}'
    ):
        scan.fit(head(), noise="residuals")
    scan.b[1] = 3000.0
    scan.b[8:] = 3000.0
    with pytest.raises(ValueError, match=r'"residuals" with 7 images, but .* 7 unknowns; expected at least 8 images'):
        scan.fit(head(), b_max=1000, noise="residuals")
