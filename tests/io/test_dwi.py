"""Scans as they come: signals and directions that are not numbers, b-values in other units."""

import jax
import jax.numpy as jnp
import nibabel as nib
import numpy as np
import pytest
from annotations import unchecked

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


def right(fit):
    """Assert that the tensors of a noise-free fit are D."""
    np.testing.assert_allclose(fit.tensors[fit.mask], np.broadcast_to(D * FSL, (fit.mask.sum(), 3, 3)), atol=1e-9)
    return fit


def test_signals_that_were_not_measured_have_no_weight(scan):
    """A slab without signal in one of two unweighted images, a negative, zero and infinite signals, and none at all."""
    lost, inside = np.zeros(SHAPE, bool), head()
    scan.signal[..., 4:, 0] = 0
    scan.signal[10, 9, 2, 5] = -3.0
    scan.signal[10, 10, 2, 6:9] = np.nan
    lost[12, 9:11, 3] = True  # without any signal
    scan.signal[12, 9, 3] = 0
    scan.signal[12, 10, 3] = np.inf
    lost[5, 9, 1] = True  # six directions of twelve: too few with the unweighted signal
    scan.signal[5, 9, 1, :8] = 0
    scan.signal[0, 0, 0, :] = np.nan  # outside
    fit = right(scan.fit(inside))
    np.testing.assert_array_equal(fit.mask, inside & ~lost)
    assert not fit.tensors[~fit.mask].any()
    notes = "\n".join(fit.notes)
    assert f"3 of {inside.sum()} voxels inside are left out, the first at (5, 9, 1): too few" in notes
    slab = inside[..., 4:].sum()
    assert f"{slab + 4} signals in {slab + 2} other voxels, the first at (3, 9, 4), are not positive" in notes
    assert f"5 images have such signals, image 0 (from 0) most, {slab}" in notes


def test_without_any_signal_there_is_no_fit(scan):
    scan.signal[:] = 0
    with pytest.raises(ValueError, match=r"the used images 0, 1, 2, .* have no positive finite signal inside the mask"):
        scan.fit(head())
    for i in range(3):  # each image has a signal somewhere
        scan.signal[i::3, ..., i::3] = 1.0
    with pytest.raises(ValueError, match=rf"in none of the {head().sum()} voxels inside .* needs 7 images"):
        scan.fit(head())


@pytest.mark.parametrize("lowest", [0, 1.25, 50, 100, 150, 200, 300])
def test_no_image_need_be_unweighted(scan, lowest):
    """The fit has an intercept: a lowest shell of 300 s/mm², with directions, gives the tensor all the same."""
    directions = np.random.default_rng(1).normal(size=(6, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    scan.directions = np.vstack([directions, scan.directions[2:]])
    scan.b = np.array([float(lowest)] * 6 + [1000.0] * 12)
    exponent = scan.b * np.einsum("na,ab,nb->n", scan.directions, D, scan.directions)
    scan.signal = np.broadcast_to(1000 * np.exp(-exponent), (*SHAPE, 18))
    fit = right(scan.fit(head()))
    assert fit.notes[0] == f"weighted least-squares fit to 18 of 18 images (6 at b = {lowest}, 12 at b = 1000 s/mm²)"


def test_an_image_of_nearly_no_weighting_needs_no_direction(scan):
    scan.b[:2] = 1.25
    fit = scan.fit(head())
    np.testing.assert_allclose(fit.tensors[fit.mask], np.broadcast_to(D * FSL, (fit.mask.sum(), 3, 3)), atol=2e-6)
    note = "2 images without a direction, b ≤ 1.25, count as unweighted, which changes diffusivities by up to 0.1%"
    assert note in fit.notes
    scan.b[:2] = 30
    with pytest.raises(
        ValueError, match=r"got 2 directions of weighted images .* the first for image 0 \(from 0, b = 3"
    ):
        scan.fit(head())


AXES, PLANE = np.tile(np.eye(3), (10, 1)), np.linspace(0, np.pi, 30, endpoint=False)
CIRCLE = np.stack([np.cos(2 * PLANE), np.sin(2 * PLANE), np.zeros(30)], axis=1)
OPPOSITE = np.random.default_rng(4).normal(size=(5, 3))
SCHEMES = {
    "three axes": (AXES, 4, "determine 3 of a tensor's 6 components"),
    "planar": (np.round(CIRCLE, 4), 4, "determine 3 of a tensor's 6 components"),
    "antipodal": (np.tile(np.vstack([OPPOSITE, -OPPOSITE]), (3, 1)), 6, "determine 5 of a tensor's 6 components"),
    "cone": (np.round(0.8 * CIRCLE + [0, 0, 0.6], 3), 6, "determine 5 of a tensor's 6 components"),
}


@pytest.mark.parametrize("unweighted", [np.zeros((2, 3)), np.array([[0.6, 0.48, 0.64], [0.48, -0.64, 0.6]])])
@pytest.mark.parametrize("name", SCHEMES)
def test_directions_that_determine_no_tensor_are_refused(scan, name, unweighted):
    """The directions at b = 0 add nothing."""
    directions, rank, words = SCHEMES[name]
    scan.directions = np.vstack([unweighted, directions / np.linalg.norm(directions, axis=1, keepdims=True)])
    scan.b = np.array([0.0] * 2 + [1000.0] * 30)
    scan.signal = np.full((*SHAPE, 32), 400.0)
    with pytest.raises(
        ValueError, match=rf"determine only {rank} of the 7 unknowns.*{words}; expected at least six axes"
    ):
        scan.fit(head())


@pytest.mark.parametrize(("b", "rank", "other"), [(1000.0, 6, 0), (np.linspace(995, 1005, 14), 6, 0), (0.0, 1, 1000)])
def test_one_shell_alone_is_refused(scan, b, rank, other):
    scan.directions = np.random.default_rng(0).normal(size=(14, 3))
    scan.directions /= np.linalg.norm(scan.directions, axis=1, keepdims=True)
    scan.b[:] = b
    with pytest.raises(
        ValueError, match=rf"only {rank} of the 7 unknowns.*do not separate the mean diffusivity.*such as b = {other}$"
    ):
        scan.fit(head())


def test_b_values_beyond_the_tensor_model_are_reported(scan):
    """With kurtosis, the signal at b = 4 000 s/mm² is larger than that of a tensor; slow diffusion is no reason."""
    more = np.random.default_rng(2).normal(size=(12, 3))
    scan.directions = np.vstack([scan.directions, more / np.linalg.norm(more, axis=1, keepdims=True)])
    scan.b = np.append(scan.b, [4065.0] * 12)
    exponent = scan.b * np.einsum("na,ab,nb->n", scan.directions, D, scan.directions)

    def images(scale, kurtosis):
        scan.signal = np.broadcast_to(
            1000 * np.exp(-scale * exponent + kurtosis / 6 * (scale * exponent) ** 2), (*SHAPE, 26)
        )

    images(1, 0.8)
    with pytest.warns(hj.AccuracyWarning, match=r"up to b = 4065 s/mm².*only for b ≲ 1500.*pass b_max=1500"):
        fit = scan.fit(head())
    assert (
        fit.notes[0]
        == "weighted least-squares fit to 26 of 26 images (2 at b = 0, 12 at b = 1000, 12 at b = 4065 s/mm²)"
    )
    assert np.trace(fit.tensors[12, 11, 3]) < 0.75 * np.trace(D)
    assert np.trace(scan.fit(head(), b_max=1500).tensors[12, 11, 3]) > 0.85 * np.trace(D)
    images(0.2, 0)  # fixed tissue: no warning
    np.testing.assert_allclose(scan.fit(head()).tensors[12, 11, 3], 0.2 * D * FSL, atol=1e-9)


def test_tensors_are_those_of_dipy(scan, rng):
    from dipy.core.gradients import gradient_table
    from dipy.reconst import dti

    noisy_scan(scan, 20, rng, sigma=30.0)
    ours = scan.fit(head())
    theirs = dti.TensorModel(gradient_table(scan.b, bvecs=scan.directions)).fit(scan.signal[head()]).quadratic_form
    np.testing.assert_allclose(ours.tensors[head()], theirs * FSL, rtol=1e-9, atol=1e-13)


def test_a_background_of_nan_is_outside(scan):
    expected = scan.fit().mask
    scan.signal[~head()] = np.nan
    fit = scan.fit()
    assert fit.mask.sum() > 600
    np.testing.assert_array_equal(fit.mask, expected)
    np.testing.assert_allclose(fit.tensors[fit.mask], np.broadcast_to(D * FSL, (fit.mask.sum(), 3, 3)), atol=1e-8)


def test_arguments_of_a_fit_are_named(scan):
    with pytest.raises(ValueError, match="mask: got a mask without voxels"):
        scan.fit(np.zeros(head().shape, bool))
    with unchecked(), pytest.raises(ValueError, match="unit: got 'x'; expected one of mm2/s"):
        scan.fit(head(), unit="x")
    with unchecked(), pytest.raises(ValueError, match="b_max: got '1000'"):
        scan.fit(head(), b_max="1000")


def test_an_image_without_signal_is_named(scan):
    scan.signal[..., 7] = np.nan
    with pytest.raises(ValueError, match=r"d\.nii\.gz: the used images 7 \(from 0\) have no positive finite signal"):
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
        ValueError, match=rf'[/\\]b: the largest b-value is .* the largest is 1000 s/mm².*pass unit="{unit}"'
    ):
        scan.fit(head())
    told = scan.fit(head(), unit=unit, b_max=1200)
    np.testing.assert_allclose(told.tensors, expected.tensors, atol=1e-12)
    assert told.notes[0] == "weighted least-squares fit to 14 of 14 images (2 at b = 0, 12 at b = 1000 s/mm²)"
    assert told.unit == "mm²/s"
    images, b, g = map(str, scan.write())
    arguments = ["info", images, "--bval", b, "--bvec", g]
    assert main(arguments) == 2
    assert f"in 1/({unit}), the largest is 1000 s/mm²: pass --unit {unit}\n" in capsys.readouterr().err
    assert main([*arguments, "--unit", unit]) == 0
    assert "12 at b = 1000 s/mm²)" in capsys.readouterr().out


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


def test_each_voxel_is_fitted_to_what_was_measured_there(scan, rng):
    """Against NumPy's least squares, voxel by voxel, with signals of which a tenth are zero or negative."""
    noisy_scan(scan, 16, rng, sigma=40.0)
    scan.signal[rng.random(scan.signal.shape) < 0.1] = 0
    scan.signal[rng.random(scan.signal.shape) < 0.02] *= -1
    fit = scan.fit(head(), bvec_frame="voxel")
    g, (rows, columns) = scan.directions, np.tril_indices(3)
    X = np.column_stack([-scan.b[:, None] * g[:, rows] * g[:, columns] * np.where(rows == columns, 1, 2), np.ones(16)])
    for voxel in map(tuple, np.argwhere(fit.mask)[::20]):
        there = scan.signal[voxel] > 0
        A, y = X[there], np.log(scan.signal[voxel][there])
        w = np.exp(A @ np.linalg.lstsq(A, y)[0])
        expected = np.linalg.lstsq(A * w[:, None], w * y)[0][:6]
        np.testing.assert_allclose(lower(fit.tensors[voxel]), expected, rtol=1e-7, atol=1e-10)


def test_negative_b_values_are_refused(scan):
    scan.b[3] = -1000.0
    with pytest.raises(ValueError, match=r"[/\\]b: got the b-value -1000; expected numbers from 0"):
        scan.fit(head())


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
