"""Error bars against dense Jacobians, exact moments, and repeated measurements."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy
from fields import random_spd

import hks_jax as hj
from hks_jax.domain import spd
from hks_jax.uncertainty.propagate import _floored
from hks_jax.uncertainty.significance import normal_score


def random_covariance(rng, shape, m, rank=None):
    root = 0.1 * rng.standard_normal((*shape, m, rank or m))
    return root @ np.swapaxes(root, -1, -2)


def components(tensors):
    rows, columns = np.tril_indices(tensors.shape[-1])
    return tensors[..., rows, columns]


def quietly(*args, **settings):
    with pytest.warns(hj.AccuracyWarning):
        return hj.uncertainty(*args, **settings)


@pytest.mark.parametrize("d", [2, pytest.param(3, marks=pytest.mark.slow)])
@pytest.mark.parametrize("rank", [pytest.param(1, marks=pytest.mark.slow), None])
def test_noise_has_the_covariance_asked_for(rng, d, rank):
    m = d * (d + 1) // 2
    covariance = random_covariance(rng, (4,), m, rank)
    noise = hj.TensorNoise(covariance)
    J = jax.jit(jax.jacobian(lambda white: components(noise.tensors(white))))(jnp.zeros((4, m))).reshape(4 * m, 4 * m)
    found = (J @ J.T).reshape(4, m, 4, m)
    for i in range(4):
        np.testing.assert_allclose(found[i, :, i], covariance[i], atol=1e-12)
    assert not found[0, :, 1].any()
    T = noise.tensors(jnp.ones((4, m)))
    np.testing.assert_array_equal(T, np.swapaxes(T, -1, -2))


def test_neighbours_share_noise_as_blurred_white_noise_does():
    grid = hj.Grid((3, 24), (0.7, 0.5))
    noise = hj.TensorNoise(np.tile(np.eye(3), (3, 24, 1, 1)), grid, correlation=0.9)
    J = jax.jit(jax.jacobian(lambda white: components(noise.tensors(white))[1, :, 0]))(jnp.zeros((3, 24, 3)))
    C = np.einsum("aijk,bijk->ab", J, J)
    np.testing.assert_allclose(np.diag(C), 1, atol=1e-12)
    r = 0.5 * np.arange(6)
    np.testing.assert_allclose(C[12, 12:18], np.exp(-(r**2) / (4 * 0.9**2)), atol=2e-4)


@pytest.mark.slow
def test_numbers_are_exact(rng):
    grid = hj.Grid((4, 3))
    D, m = random_spd(rng, grid.shape, 0.2), 3
    noise = hj.TensorNoise(1e-3 * random_covariance(rng, grid.shape, m), grid, correlation=0.6)

    def mean(D):
        pairs = hj.eigenpairs(hj.TensorField.from_diffusion(grid, D, "inverse"), 12, solver="dense")
        return jnp.mean(hj.hks(pairs, [3.0])[:, :2])

    bars = hj.uncertainty(mean, D, noise)
    assert (bars.method, bars.sampling_error) == ("exact", 0)
    g = jax.grad(mean)(jnp.asarray(D))
    J = jax.jacobian(noise.tensors)(jnp.zeros((*grid.shape, m))).reshape(g.size, -1)
    np.testing.assert_allclose(bars.deviation, np.linalg.norm(np.ravel(g) @ J), rtol=1e-10)


@pytest.mark.slow
def test_the_derivative_by_the_noise_says_which_measurement_matters(rng):
    D = random_spd(rng, (5, 4), 0.2)

    def volume(D):
        return jnp.sum(jnp.sqrt(spd.determinant(D)))

    def variance(covariance):
        return hj.uncertainty(volume, D, hj.TensorNoise(covariance), method="exact").deviation ** 2

    slope = jax.jit(jax.grad(variance))(jnp.asarray(1e-3 * random_covariance(rng, (5, 4), 3)))
    g = jax.jit(jax.grad(volume))(jnp.asarray(D))
    parts = components(g + np.swapaxes(g, -1, -2)) * np.where(np.equal(*np.tril_indices(2)), 0.5, 1.0)
    symmetric = (slope + np.swapaxes(slope, -1, -2)) / 2
    np.testing.assert_allclose(symmetric, parts[..., :, None] * parts[..., None, :], rtol=1e-8, atol=1e-14)


@pytest.mark.slow
def test_maps_agree_with_the_dense_jacobian(rng):
    grid = hj.Grid((5, 4))
    D = random_spd(rng, grid.shape, 0.2)
    noise = hj.TensorNoise(1e-4 * random_covariance(rng, grid.shape, 3), grid)

    def signature(D):
        pairs = hj.eigenpairs(hj.TensorField.from_diffusion(grid, D, "inverse"), 20, solver="dense")
        return hj.hks(pairs, [2.0, 8.0], "flat")

    J = jax.jacobian(lambda white: signature(D + noise.tensors(white)))(jnp.zeros((*grid.shape, 3)))
    expected = np.sqrt(np.sum(np.square(J), axis=(-3, -2, -1)))
    for method in ("resample", "linear"):
        bars = hj.uncertainty(signature, D, noise, method=method, draws=200)
        ratio = np.asarray(bars.deviation) / expected
        assert abs(np.sqrt(np.mean(ratio**2)) - 1) < 2 * bars.sampling_error
        assert np.std(ratio) < 1.5 * bars.sampling_error
        assert np.all(bars.trusted)
        assert np.all(np.abs(bars.bias) < 0.1 * bars.deviation)
        degrees = 200 if method == "linear" else 150  # four maps are three samples
        assert bars.sampling_error == pytest.approx((2 * degrees) ** -0.5)


def test_bias_and_departure_from_linearity_of_a_quadratic_are_exact(rng):
    # E det(D + δ) − det D = cov(xx, yy) − var(xy), and var = gᵀΣg besides what is quadratic.
    D, covariance = random_spd(rng, (40, 50), 0.1), random_covariance(rng, (40, 50), 3) / 10
    bars = hj.uncertainty(spd.determinant, D, hj.TensorNoise(covariance), draws=64, method="resample")
    expected = covariance[..., 0, 2] - covariance[..., 1, 1]
    error, stated = np.asarray(bars.bias) - expected, np.sqrt(np.mean(np.square(bars.bias_error)))
    assert abs(error.mean()) < 0.1 * stated
    assert 0.9 < np.sqrt(np.mean(error**2)) / stated < 1.1
    g = np.stack([D[..., 1, 1], -2 * D[..., 0, 1], D[..., 0, 0]], axis=-1)
    linear = np.einsum("...a,...ab,...b->...", g, covariance, g)
    assert abs(np.mean(np.square(bars.deviation) / linear) - 1) < 0.02
    # Nearly the whole bias of a map that is certain and nearly linear is corrected.
    part = np.sum((bars.value - bars.corrected) * bars.bias) / np.sum(np.square(bars.bias))
    assert 0.8 < part < 1


@pytest.mark.slow
def test_noise_of_modes_is_shared_as_they_are(rng):
    # A mode that all nodes share does not average out in the mean over nodes; independent noise does.
    grid, D = hj.Grid((20, 20)), np.tile(np.eye(2), (20, 20, 1, 1))
    shared, own = 0.03, 0.05
    modes = own / np.sqrt(30) * rng.choice([-1.0, 1.0], (20, 20, 30, 3))
    modes = np.concatenate([modes, np.full((20, 20, 1, 3), shared) * [1, 0, 1]], axis=2)
    noise = hj.TensorNoise.from_modes(modes, grid, unknowns=7)
    np.testing.assert_allclose(noise.covariance[..., 0, 0], own**2 + shared**2, rtol=1e-6)

    def mean(D):
        return jnp.trace(D, axis1=-2, axis2=-1).mean()

    bars = hj.uncertainty(mean, D, noise)
    assert (bars.method, bars.freedom) == ("exact", 24)
    expected = 4 * shared**2 + np.sum(modes[..., :30, ::2].sum(axis=-1).mean(axis=(0, 1)) ** 2)
    np.testing.assert_allclose(bars.deviation**2, expected, rtol=1e-10)
    drawn = hj.uncertainty(mean, D, noise, method="resample", draws=400)
    assert drawn.freedom == pytest.approx(1 / (1 / 300 + 1 / 24))
    assert abs(drawn.deviation / bars.deviation - 1) < 3 * 600**-0.5
    with pytest.raises(ValueError, match="n > unknowns = 31"):
        hj.TensorNoise.from_modes(modes, grid, unknowns=31)


def flat_torus(n, k, times, tensor=((1.0, 0.0), (0.0, 1.0))):
    """Return constant tensors on a flat torus, and a function from tensors to their signature."""
    grid, D = hj.Grid((n, n)), np.tile(tensor, (n, n, 1, 1))

    def signature(D):
        field = hj.TensorField.from_diffusion(grid, D, "inverse")
        return hj.hks(hj.eigenpairs(field, k, "periodic", solver="dense"), times, "flat")

    return D, signature


def disc():
    """Return constant tensors on a disc without the effect of its boundary, and a function to their signature."""
    apart = (np.arange(15) - 7) ** 2
    grid, D = hj.Grid((15, 15), mask=np.add.outer(apart, apart) <= 49), np.tile(np.diag([1.4, 0.7]), (15, 15, 1, 1))
    D[~grid.inside] = np.diag([100.0, 90.0])

    def signature(D):
        field = hj.TensorField.from_diffusion(grid, D, "inverse")
        return hj.hks(hj.eigenpairs(field, 40, "mean", solver="dense"), [0.5, 2.0, 8.0], "flat")

    return D, signature


def square():
    """Return smooth tensors on a square, and a function from tensors to their signature."""
    grid = hj.Grid((10, 10))
    x, y = np.moveaxis(grid.nodes, -1, 0)
    D = (1 + 0.4 * np.sin(x / 2) * np.cos(y / 3))[..., None, None] * np.array([[1.4, 0.3], [0.3, 0.6]])

    def signature(D):
        field = hj.TensorField.from_diffusion(grid, D, "inverse")
        return hj.hks(hj.eigenpairs(field, 50, solver="dense"), [2.0, 8.0, 32.0], "flat")

    return D, signature


def sphere():
    """Return tensors at the vertices of a sphere, and a function to their signature at small and large times."""
    mesh = hj.examples.sphere_mesh(2)
    x = np.asarray(mesh.vertices)
    D = (1 + 0.4 * np.sin(3 * x[:, 0]))[:, None, None] * (0.6 * np.eye(3) + x[:, ::-1, None] * x[:, None, ::-1])

    def signature(D):
        cells = hj.SurfaceMesh.from_tensors(x, mesh.faces, D, metric="inverse")
        return hj.hks(hj.eigenpairs(cells, 21, solver="dense"), [0.05, 0.1, 1.0], "flat")

    return D, signature


TORUS, DISC = flat_torus(12, 60, np.array([2.0, 4.0, 8.0])), disc()
LARGE_TORUS = flat_torus(22, 150, np.array([2.0, 4.0, 8.0, 16.0]))
SQUARE, SPHERE = square(), sphere()


@cache
def many_measurements(signature, number, of, draws=8):
    """Return a function that is compiled once for all levels of noise."""

    @jax.jit
    def all_of(D, noise, level):
        truth = signature(D)

        def one(seed):
            white = jax.random.normal(jax.random.key(seed + 1_000_000), noise.white_shape, D.dtype)
            values, vectors = jnp.linalg.eigh(D + noise.tensors(white))
            measured = jnp.einsum("...ia,...a,...ja->...ij", vectors, jnp.maximum(values, 0.01), vectors)
            own = hj.TensorNoise(hj.TensorNoise.relative(measured, 1.0).covariance * level**2)
            bars = hj.uncertainty(signature, measured, own, method="resample", draws=draws, seed=seed)
            nodes = tuple(range(1, truth.ndim))
            known = jnp.isfinite(truth)
            return [jnp.mean(each, axis=nodes, where=known) for each in of(bars, truth)]

        return jax.tree.map(lambda each: each.mean(axis=0), jax.lax.map(one, jnp.arange(number)))

    return all_of


def measured_often(D, signature, level, number, of):
    """Return the mean of a function of error bars and the truth over measurements with noise; (n_times,) each."""
    noise = hj.TensorNoise.relative(D, level)
    return [np.asarray(each) for each in many_measurements(signature, number, of)(jnp.asarray(D), noise, level)]


def compared_with_one(bars, truth):
    """The share of noise beyond two, with and without the null subtracted, and the discoveries in noise alone."""
    plain = (bars.value - 1) / bars.deviation
    low, high = bars.interval(0.95)
    outside = (bars.null < low) | (bars.null > high)
    z, ratio = bars.z(), bars.signal_to_noise.reshape(-1, *[1] * (truth.ndim - 1)) * jnp.ones_like(truth)
    return abs(z) > 2, abs(plain) > 2, outside == (abs(z) > 1.959964), bars.discoveries(), ratio


def compared_with_the_truth(bars, truth):
    """The squares of the errors of measured and corrected values, and whether intervals contain the truth."""
    (a, b), (c, d) = bars.interval(0.68), bars.interval(0.95)
    errors = ((each - truth) ** 2 for each in (bars.value, bars.corrected))
    return [*errors, (a < truth) & (truth < b), (c < truth) & (truth < d)]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("field", "level", "number", "old"),
    [
        (TORUS, 0.03, 8, 0.35),
        (DISC, 0.05, 8, 0.3),
        (flat_torus(12, 60, np.array([0.5, 2.0, 8.0]), ((1.6, 0.5), (0.5, 0.6))), 0.03, 8, 0),
        (LARGE_TORUS, 0.03, 8, 0.4),
        (LARGE_TORUS, 0.1, 8, 0.1),
    ],
    ids=["torus", "disc", "anisotropic", "torus 22, 3 %", "torus 22, 10 %"],
)
def test_noise_alone_is_beyond_two_as_often_as_a_normal_number(field, level, number, old):
    share, from_one, same, declared, ratio = measured_often(*field, level, number, compared_with_one)
    assert (share < 0.062).all()
    assert share.mean() > 0.02
    assert (from_one > old).all()  # the discretisation counts as signal
    assert same.min() == 1
    assert declared.max() < 0.05
    assert ratio.max() < 0.5


@pytest.mark.slow
@pytest.mark.parametrize(
    ("field", "level", "worst", "best"),
    [
        (SPHERE, 0.2, 1.04, 0.99),  # with the whole bias, the ratio is 1.4
        *((SPHERE, level, 1.04, 1.01) for level in (0.03, 0.1)),
        (SQUARE, 0.05, 1.02, 0.95),
        *((field, level, 1.04, 1.01) for field in (SQUARE, TORUS) for level in (0.03, 0.1, 0.2)),
    ],
)
def test_corrected_values_are_not_worse_and_intervals_contain_the_truth(field, level, worst, best):
    value, corrected, in_68, in_95 = measured_often(*field, level, 24, compared_with_the_truth)
    ratio = np.sqrt(corrected / value)
    assert ratio.max() < worst
    assert ratio.min() < best
    assert (in_68 > 0.62).all()
    assert (in_95 > 0.92).all()


@pytest.mark.parametrize("freedom", [1.5, 6.0, 24.0, 150.0])
@pytest.mark.slow
def test_scores_have_the_probabilities_of_students_distribution(freedom):
    x = np.array([-30.0, -3.0, -0.2, 0.0, 1e-6, 2.45, 9.0])
    expected = -np.sign(x) * scipy.special.ndtri(scipy.special.stdtr(freedom, -np.abs(x)))
    score, slope = jax.vmap(jax.value_and_grad(lambda x: normal_score(x, freedom)))(jnp.asarray(x))
    np.testing.assert_allclose(score, expected, rtol=1e-6, atol=1e-7)
    low, high = (normal_score(jnp.asarray(x + step), freedom) for step in (-1e-4, 1e-4))
    np.testing.assert_allclose(slope, (high - low) / 2e-4, rtol=1e-3, atol=1e-6)
    single = normal_score(jnp.asarray(x, jnp.float32), freedom)
    np.testing.assert_allclose(single, np.maximum(expected, -12.95), rtol=1e-4, atol=1e-4)
    assert normal_score(jnp.float32(7.0), np.inf) == 7


@pytest.mark.parametrize("correlation", [0.0, 1.5, 4.0])
@pytest.mark.slow
def test_few_discoveries_are_false(rng, correlation):
    grid = hj.Grid((16, 16))
    apart = np.hypot(*np.moveaxis(grid.nodes - 8, -1, 0))
    bump = np.where(apart < 4, 0.4, 0.0)
    noise = hj.TensorNoise(np.tile(0.05**2 * np.eye(3), (16, 16, 1, 1)), grid, correlation)

    @jax.jit
    def both(seed):
        change = noise.tensors(jax.random.normal(jax.random.key(seed + 1_000_000), (16, 16, 3)))
        found = []
        for signal in (np.zeros_like(bump), bump):
            D = jnp.eye(2) * (1 + signal)[..., None, None] + change
            bars = hj.uncertainty(lambda D: D[None, ..., 0, 0], D, noise, method="resample", draws=32, seed=seed)
            found.append(bars.discoveries(0.1, 1.0)[0])
        return found

    null, found = jax.lax.map(both, jnp.arange(100))
    assert null.any(axis=(1, 2)).mean() < 0.16  # 0.1, and two standard deviations of a share of 100
    false = (found & (bump == 0)).sum(axis=(1, 2)) / jnp.maximum(found.sum(axis=(1, 2)), 1)
    assert false.mean() < 0.12
    assert found[:, bump > 0].mean() > 0.8


@pytest.mark.slow
def test_the_null_has_constant_tensors_inside_the_domain():
    D, signature = DISC
    bars = hj.uncertainty(signature, D, hj.TensorNoise.relative(D, 0.01), method="resample")
    np.testing.assert_allclose(bars.null, bars.value, rtol=1e-12)  # large tensors outside the mask do not count
    with pytest.raises(ValueError, match="rate: got 2"):
        bars.discoveries(2.0)
    two = hj.uncertainty(lambda D: {"a": D[0, 0, 0], "b": D[0, 1]}, D, hj.TensorNoise.relative(D, 0.01))
    assert two.z(1.0)["a"].shape == two.z()["a"].shape == (2,)
    assert two.z({"a": 1.0, "b": 2.0})["b"].shape == two.discoveries()["b"].shape == (2, 2)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::hks_jax.AccuracyWarning")  # of a few of the measurements, by chance
def test_intervals_contain_the_truth_as_often_as_they_say(rng):
    grid = hj.Grid((7, 7), mask=np.add.outer((np.arange(7) - 3) ** 2, (np.arange(7) - 3) ** 2) < 12)
    D = random_spd(rng, grid.shape, 0.3)

    @jax.jit
    def signature(D):
        pairs = hj.eigenpairs(hj.TensorField.from_diffusion(grid, D, "inverse"), 16, "mean", solver="dense")
        return hj.hks(pairs, [3.0, 12.0], "flat")

    truth, inside = np.asarray(signature(jnp.asarray(D))), {0.68: [], 0.95: []}
    for seed in range(100):
        change = hj.TensorNoise.relative(D, 0.04).tensors(jnp.asarray(rng.standard_normal((7, 7, 3))))
        measured = D + change
        noise = hj.TensorNoise.relative(measured, 0.04)
        bars = hj.uncertainty(signature, measured, noise, draws=16, method="resample", seed=seed, compiled=False)
        for level, found in inside.items():
            low, high = bars.interval(level)
            found.append(((low < truth) & (truth < high))[:, np.isfinite(truth[0])])
    for level, found in inside.items():
        np.testing.assert_allclose(np.mean(found, axis=(0, 2)), level, atol=0.06)


@pytest.mark.slow
def test_seeds_in_a_batch_give_the_draws_of_each(rng):
    D = jnp.asarray(random_spd(rng, (5, 6), 0.3))
    noise = hj.TensorNoise.relative(D, 0.05)

    def deviation(seed):
        return hj.uncertainty(lambda D: D[..., 0, 0] ** 2, D, noise, method="resample", draws=8, seed=seed).deviation

    together = jax.vmap(deviation)(jnp.arange(3))
    np.testing.assert_allclose(together, [deviation(seed) for seed in range(3)], rtol=1e-12)


def test_what_is_beyond_linear_or_indefinite_is_said(rng):
    D = random_spd(rng, (30, 30), 0.1)
    bars = quietly(spd.inverse, D, hj.TensorNoise.relative(D, 0.15), draws=8)
    assert not np.any(bars.trusted)
    assert "not linear" in bars.messages()[0]
    bars = quietly(spd.inverse, D, hj.TensorNoise.relative(D, 0.5), draws=8)
    assert "indefinite" in bars.messages()[0]
    assert np.isfinite(bars.deviation).all()


def test_two_scans_tell_level_and_correlation(rng):
    grid = hj.Grid((60, 50), (2.0, 3.0), mask=np.indices((60, 50)).sum(axis=0) > 20)
    D = np.where(grid.inside[..., None, None], random_spd(rng, grid.shape, 0.3), 0)
    noise = hj.TensorNoise.relative(D, 0.07, grid, correlation=2.0)
    first, second = (D + noise.tensors(jnp.asarray(rng.standard_normal((60, 50, 3)))) for _ in range(2))
    found = hj.TensorNoise.from_scans(first, second, grid)
    ratio = np.trace(found.covariance[grid.inside].sum(0)) / np.trace(noise.covariance[grid.inside].sum(0))
    assert abs(ratio - 1) < 0.1
    assert abs(found.correlation - 2.0) < 0.2


def test_roughness_tells_the_level_on_smooth_fields(rng):
    grid = hj.Grid((40, 40))
    x, y = np.meshgrid(*(np.arange(40) / 40,) * 2, indexing="ij")
    D = (1 + 0.4 * np.sin(6 * x) * np.cos(5 * y))[..., None, None] * np.diag([1.5, 0.5])
    noisy = D + hj.TensorNoise.relative(D, 0.05).tensors(jnp.asarray(rng.standard_normal((40, 40, 3))))
    found = hj.TensorNoise.from_roughness(noisy, grid)
    ratio = np.sqrt(found.covariance / np.asarray(hj.TensorNoise.relative(D, 0.05).covariance))[..., 0, 0]
    assert abs(np.median(ratio) - 1) < 0.1


def test_noise_needs_no_tensors_outside_the_mask(rng):
    inside = np.ones((9, 8), bool)
    inside[:3, :4] = False
    grid, first, second = hj.Grid((9, 8), mask=inside), random_spd(rng, (9, 8)), random_spd(rng, (9, 8))
    for of in (
        lambda D: hj.TensorNoise.relative(D(first), 0.1, grid),
        lambda D: hj.TensorNoise.from_scans(D(first), D(second), grid),
        lambda D: hj.TensorNoise.from_roughness(D(first), grid),
    ):
        zero, nan = (
            of(lambda x, value=value: np.where(inside[..., None, None], x, value)).covariance for value in (0.0, np.nan)
        )
        np.testing.assert_array_equal(nan, zero)
    with pytest.raises(ValueError, match="correlation: got a length beside modes"):
        hj.TensorNoise(np.tile(np.eye(3), (9, 8, 1, 1)), grid, 2.0, modes=jnp.ones((9, 8, 4, 3)))


@pytest.mark.parametrize("d", [pytest.param(2, marks=pytest.mark.slow), 3])
def test_smoothing_is_log_euclidean_and_keeps_to_the_mask(rng, d):
    shape = (7, 6, 5)[:d]
    mask = rng.random(shape) < 0.8
    grid = hj.Grid(shape, 0.5, mask=mask, components="all")
    D = random_spd(rng, shape)
    inside = grid.inside
    smooth = np.asarray(hj.smooth_tensors(grid, np.where(mask[..., None, None], D, np.eye(d)), 0.6))
    x = np.argwhere(inside) * 0.5
    weights = np.exp(-np.sum((x[:, None] - x) ** 2, axis=-1) / (2 * 0.6**2))
    expected = np.einsum("ij,j...->i...", weights / weights.sum(1, keepdims=True), np.asarray(spd.log(D[inside])))
    np.testing.assert_allclose(spd.log(smooth[inside]), expected, atol=1e-10)
    np.testing.assert_array_equal(hj.smooth_tensors(grid, D, 0), np.where(inside[..., None, None], D, np.eye(d)))


@pytest.mark.slow
def test_smoothing_lowers_noise_and_tells_what_it_smears(rng):
    grid = hj.Grid((16, 16))
    D = (1 + 0.3 * np.cos(np.arange(16) / 2))[:, None, None, None] * np.tile(np.eye(2), (16, 16, 1, 1))
    noise = hj.TensorNoise.relative(D, 0.05, grid)
    plain, smooth = (
        hj.uncertainty(spd.determinant, D, noise, method="resample", draws=32, smoothing=w) for w in (0.0, 1.0)
    )
    assert plain.smear is None
    assert np.mean(smooth.deviation) < 0.4 * np.mean(plain.deviation)
    shift = np.asarray(smooth.value - plain.value)[4:-4]
    assert np.corrcoef(shift.ravel(), np.asarray(smooth.smear)[4:-4].ravel())[0, 1] > 0.95


def test_noise_lowers_no_diffusivity_below_a_fraction(rng):
    """Relative to the measured tensor, a noisy tensor has no eigenvalue below ½; tensors with less noise stay."""
    D = random_spd(rng, (30, 20), 0.1).reshape(-1, 2, 2)
    change = 0.3 * rng.standard_normal(D.shape)
    given = D + change + change.swapaxes(-1, -2)

    def ratios(tensors):
        pairs = zip(np.asarray(tensors), D, strict=True)
        return np.stack([scipy.linalg.eigh(one, of, eigvals_only=True) for one, of in pairs])

    noisy, share = _floored(jnp.asarray(D), jnp.asarray(given), 0.5)
    before = ratios(given)
    low = before[:, 0] < 0.5
    assert 0.05 < low.mean() < 0.95
    np.testing.assert_allclose(ratios(noisy), np.maximum(before, 0.5), rtol=1e-9)
    np.testing.assert_allclose(share, low.mean(), rtol=1e-12)
    np.testing.assert_array_equal(noisy[~low], given[~low])


@pytest.mark.slow
def test_an_interrupted_computation_goes_on(rng, tmp_path):
    D, told, samples, stored = random_spd(rng, (3, 3), 0.1), [], [], {"checkpoint": tmp_path / "c.npz"}
    settings = {"noise": hj.TensorNoise.relative(D, 0.05), "draws": 22, "method": "resample"}
    whole = hj.uncertainty(spd.determinant, D, **settings)

    def stop(text):
        told.append(text)
        if len(told) == 11:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        hj.uncertainty(spd.determinant, D, **settings, progress=stop, each=samples.append, **stored)
    assert told[-1] == "11 of 24 noisy maps"
    assert len(samples) == 6
    again = []
    resumed = hj.uncertainty(spd.determinant, D, **settings, progress=told.append, each=again.append, **stored)
    assert told[11:] == [f"{i} of 24 noisy maps" for i in range(9, 25)]
    assert all(0 <= text.seconds_left < 100 for text in told[11:])
    np.testing.assert_array_equal(again[:6], samples)
    np.testing.assert_allclose(np.mean(np.square(again), axis=0), whole.deviation**2, rtol=1e-12)
    np.testing.assert_allclose(resumed.deviation, whole.deviation, rtol=1e-14)
    fewer = hj.uncertainty(spd.determinant, D, **(settings | {"draws": 8}), each=again.append, **stored)
    assert fewer.draws == 24  # all that the file has
    np.testing.assert_array_equal(fewer.deviation, resumed.deviation)
    np.testing.assert_array_equal(fewer.trusted, resumed.trusted)
    with pytest.raises(ValueError, match="belongs to another computation"):
        hj.uncertainty(spd.determinant, 2 * D, **settings, each=samples.append, **stored)


def test_bad_input_is_named(rng):
    D = random_spd(rng, (4, 3), 0.1)
    grid, good = hj.Grid((4, 3)), np.tile(1e-3 * np.eye(3), (4, 3, 1, 1))
    bad = good.copy()
    bad[2, 1] = np.diag([1, -2, 1])
    for covariance, text in (
        (bad, r"semidefinite at 1 of 12 nodes, the worst at \(2, 1\) with least eigenvalue -2, entries up to 2;"),
        (np.where(np.arange(3) == 1, np.nan, good), r"not finite, .* at 12 of 12 nodes"),
        (good[..., :2], r"expected \(\*shape, m, m\)"),
    ):
        with pytest.raises(ValueError, match=text):
            hj.TensorNoise(covariance)
    with pytest.raises(ValueError, match="correlation: got a length but no grid"):
        hj.TensorNoise(good, correlation=1.0)
    with pytest.raises(ValueError, match=r"noise: got a standard deviation of .* squared unit"):
        hj.uncertainty(spd.determinant, 1e-6 * D, hj.TensorNoise(good))
    with pytest.raises(ValueError, match="noise: got a covariance of shape"):
        hj.uncertainty(spd.determinant, D[:2], hj.TensorNoise(good))
    with pytest.raises(ValueError, match="noise has no grid"):
        hj.uncertainty(spd.determinant, D, hj.TensorNoise(good), smoothing=1.0)
    with pytest.raises(ValueError, match=r"Pass compiled=False"):
        hj.uncertainty(lambda D: np.linalg.det(D), D, hj.TensorNoise(good))
    assert hj.uncertainty(lambda D: np.linalg.det(D), D, hj.TensorNoise(good), compiled=False).draws == 8
    with pytest.raises(ValueError, match="draws: got 4"):
        hj.uncertainty(spd.determinant, D, hj.TensorNoise(good), draws=4)
    with pytest.raises(ValueError, match="got equal tensors"):
        hj.TensorNoise.from_scans(D, D, grid)
