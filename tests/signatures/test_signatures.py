import re
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special
from annotations import unchecked
from fields import flat, random_spd, turning
from scipy.linalg import expm

import hks_jax as hj
from hks_jax.signatures import contractions
from hks_jax.signatures.truncation import beyond, beyond_by_weyl, median_of_shares, share_of_inverse_squares


@pytest.fixture(scope="module")
def field() -> hj.TensorField:
    rng = np.random.default_rng(7)
    mask = np.ones((8, 9), dtype=bool)
    mask[:3, 5:] = False
    return hj.TensorField(hj.Grid((8, 9), 0.2, mask=mask), random_spd(rng, (8, 9)))


@pytest.fixture(scope="module")
def pairs(field) -> hj.Eigenpairs:
    return hj.eigenpairs(field, hj.assemble(field).space.n_dof)


TIMES = [0.1, 0.5, 2.0]


def test_a_signature_in_parts_is_the_whole_signature_and_its_derivative(rng, monkeypatch):
    """The squares of many eigenvectors are computed for some nodes at a time; the last part overlaps another."""
    weights, vectors, tangent = (jnp.asarray(rng.standard_normal(shape)) for shape in ((3, 5), (5, 11), (5, 11)))
    monkeypatch.setattr(contractions, "_SQUARES", 20)
    value, change = jax.jvp(lambda x: contractions.Diagonal().weighted(weights, x), (vectors,), (tangent,))
    np.testing.assert_allclose(value, weights @ vectors**2, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(change, 2 * weights @ (vectors * tangent), rtol=1e-13, atol=1e-13)
    found = jax.grad(lambda x: jnp.sum(jnp.sin(contractions.Diagonal().weighted(weights, x))))(vectors)
    expected = jax.grad(lambda x: jnp.sum(jnp.sin(jnp.matmul(weights, x**2, precision="highest"))))(vectors)
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)


def kernel_by_matrix_exponential(pairs, t) -> np.ndarray:
    """exp(−t M⁻¹K) M⁻¹, without eigenpairs."""
    M = np.asarray(pairs.pencil.mass.to_dense())
    return expm(-t * np.linalg.solve(M, np.asarray(pairs.pencil.stiffness.to_dense()))) @ np.linalg.inv(M)


def test_hks_and_kernel_against_the_matrix_exponential(pairs):
    inside, rtol = pairs.space.domain, 1e-9
    kernel = hj.heat_kernel(pairs, TIMES, np.argwhere(inside))[..., inside]
    for t, ours, diagonal in zip(TIMES, kernel, hj.hks(pairs, TIMES), strict=True):
        expected = kernel_by_matrix_exponential(pairs, t)
        np.testing.assert_allclose(ours, expected, rtol=rtol, atol=1e-10)
        np.testing.assert_allclose(diagonal[inside], np.diag(expected), rtol=rtol)
    assert np.isnan(hj.hks(pairs, TIMES)[:, ~inside]).all()


def test_heat_trace_is_the_trace_and_the_integral_of_the_kernel(pairs):
    for t, trace in zip(TIMES, hj.heat_trace(pairs, TIMES), strict=True):
        kernel = kernel_by_matrix_exponential(pairs, t)
        assert np.trace(kernel @ pairs.pencil.mass.to_dense()) == pytest.approx(float(trace))
    lumped, times = hj.eigenpairs(flat((8, 9), (1.0, 1.0)), 72, mass="lumped"), TIMES[1:]
    integral = hj.hks(lumped, times).reshape(2, -1) @ lumped.pencil.mass.diagonal()
    np.testing.assert_allclose(integral, hj.heat_trace(lumped, times), rtol=1e-12)


def test_normalisations_by_name(pairs):
    raw, times = hj.hks(pairs, TIMES), np.array(TIMES)[:, None, None]
    np.testing.assert_allclose(hj.hks(pairs, TIMES, "flat"), 4 * np.pi * times * raw)
    np.testing.assert_allclose(hj.hks(pairs, TIMES, "volume"), pairs.pencil.volume * raw)
    trace = hj.heat_trace(pairs, TIMES)[:, None, None]
    np.testing.assert_allclose(hj.hks(pairs, TIMES, "heat-trace"), raw / trace)
    late = hj.hks(pairs, [1e5], "volume")
    np.testing.assert_allclose(late[0, pairs.space.domain], 1, rtol=1e-9)
    with (
        unchecked(),
        pytest.raises(
            ValueError, match='normalisation: got \'area\'; expected "raw", "heat-trace", "volume" or "flat"'
        ),
    ):
        hj.hks(pairs, TIMES, "area")


def test_wks_is_a_weighted_mean_of_squares(pairs):
    energies, sigma = hj.default_energies(pairs, 40)
    got = hj.wks(pairs, energies, sigma)
    positive, functions = pairs.eigenvalues[1:], np.asarray(pairs.eigenfunctions[1:])
    weights = np.exp(-((energies[:, None] - np.log(positive)) ** 2) / (2 * sigma**2))
    expected = np.einsum("ei,i...->e...", weights / weights.sum(1, keepdims=True), functions**2)
    np.testing.assert_allclose(got, expected, rtol=1e-10)
    assert hj.wks(pairs).shape == (100, 8, 9)
    # Far outside the spectrum the nearest mode takes over; nothing underflows to 0/0.
    far = hj.wks(pairs, [-1e3], 0.1)[0]
    np.testing.assert_allclose(far, functions[0] ** 2, rtol=1e-9)


def test_scale_invariance_takes_log_spaced_times(pairs):
    single = hj.eigenpairs(flat((6, 7), (1.0, 1.1)), 42, solver="dense")
    single = jax.tree.map(lambda x: x.astype(np.float32) if x.dtype == np.float64 else x, single)
    for given in (pairs, single):
        for times in (np.geomspace(2.0, 8.0, 300), np.geomspace(8.0, 2.0, 4)):
            hj.scale_invariant_hks(given, 1, times=times)
        with pytest.raises(ValueError, match=r"times: got steps of log t from 0.2877 to 0.6931; expected equal steps"):
            hj.scale_invariant_hks(given, 2, times=[2.0, 4.0, 6.0, 8.0])


def test_wks_tells_of_energies_to_which_pairs_are_missing():
    pencil = hj.assemble(flat((12, 13), (1.0, 1.1)))
    few, every = (hj.eigenpairs(pencil, k, solver="dense") for k in (40, 156))
    last, sigma = float(jnp.log(few.eigenvalues[-1])), 0.3
    highest = last - 2 * sigma
    for energy, error in ((last - 0.3, 0.1), (last + 0.5, 0.5)):
        with pytest.warns(
            hj.AccuracyWarning, match=f"energies: 1 of 2 .* Use energies of at most {highest:.4g}, .* more"
        ):
            found = hj.wks(few, [highest, energy], sigma)
        exact = hj.wks(every, [highest, energy], sigma)
        assert jnp.max(jnp.abs(found / exact - 1)[1]) > error
    # The largest energy without a warning; the default energies, also as arguments; every pair; traced energies.
    np.testing.assert_allclose(found[0], exact[0], rtol=0.1)
    hj.wks(few)
    hj.wks(few, *hj.default_energies(few, 30))
    jax.jit(lambda e: hj.wks(few, e, sigma))(jnp.array([last]))


@pytest.mark.slow
def test_scale_invariance(field, pairs):
    scaled = hj.eigenpairs(hj.TensorField(field.grid, 9.0 * field.tensors), pairs.k)
    np.testing.assert_allclose(hj.scale_invariant_hks(scaled), hj.scale_invariant_hks(pairs), rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(hj.shape_dna(scaled), hj.shape_dna(pairs), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(hj.wks(scaled) * 9, hj.wks(pairs), rtol=1e-8)
    np.testing.assert_allclose(hj.hks(scaled, 9 * np.array(TIMES)) * 9, hj.hks(pairs, TIMES), rtol=1e-8)
    np.testing.assert_allclose(hj.default_times(scaled, 5), 9 * hj.default_times(pairs, 5), rtol=1e-9)


def test_distances_are_metrics_with_their_definitions(pairs):
    inside = pairs.space.domain
    nodes, phi = np.argwhere(inside), np.asarray(pairs.vectors)
    gaps = phi[:, :, None] - phi[:, None, :]
    diffusion = hj.diffusion_distance(pairs, [0.3], nodes)[0][:, inside]
    expected = np.sqrt(np.einsum("i,ixy->xy", np.exp(-0.6 * pairs.eigenvalues), gaps**2))
    np.testing.assert_allclose(diffusion, expected, rtol=1e-12, atol=1e-14)
    late = hj.diffusion_distance(pairs, [20.0], nodes[0])[0, 0][inside]
    first = np.exp(-20.0 * pairs.eigenvalues[1]) * np.abs(phi[1] - phi[1][0])
    np.testing.assert_allclose(late, first, rtol=1e-6, atol=1e-6 * first.max())
    biharmonic = hj.biharmonic_distance(pairs, nodes)[:, inside]
    expected = np.sqrt(np.einsum("i,ixy->xy", np.asarray(pairs.eigenvalues)[1:] ** -2.0, gaps[1:] ** 2))
    np.testing.assert_allclose(biharmonic, expected, rtol=1e-12, atol=1e-14)
    embedding = hj.global_point_signature(pairs)[:, inside]
    np.testing.assert_allclose(embedding * np.sqrt(pairs.eigenvalues[1:, None]), phi[1:], rtol=1e-12)
    # The root at distance zero has a derivative, and it is zero.
    slope = jax.grad(lambda t: hj.diffusion_distance(pairs, t, nodes[0])[0, 0, *nodes[0]])(jnp.array([0.3]))
    assert np.isfinite(slope).all()


def test_default_times_span_the_spectrum(field):
    torus = hj.TensorField(hj.Grid(field.grid.shape, field.grid.spacing), field.tensors)  # has no boundary
    pairs = hj.eigenpairs(torus, 40, "periodic", solver="dense")
    times = hj.default_times(pairs, 7)
    assert times[0] * pairs.eigenvalues[-1] == pytest.approx(4 * np.log(10))
    assert times[-1] * pairs.eigenvalues[1] == pytest.approx(4 * np.log(10))
    np.testing.assert_allclose(np.diff(np.log(times)), np.log(times[-1] / times[0]) / 6)
    shown = hj.default_times(pairs, 7, 0.01)
    assert shown[0] == pytest.approx(float(times[0]))
    assert shown[-1] * pairs.eigenvalues[1] == pytest.approx(2 * np.log(10))
    assert hj.default_times(pairs, 2, 1 - 1e-9)[1] == pytest.approx(2 * float(times[0]))  # not near the first
    with pytest.raises(ValueError, match="decay: got 1"):
        hj.default_times(pairs, 2, 1.0)


@pytest.mark.parametrize(
    ("shape", "boundary", "potential"),
    [
        ((12, 13), "neumann", None),
        ((12, 13), "dirichlet", None),
        ((12, 13), "neumann", 5.0),
        pytest.param((7, 6, 7), "mean", None, marks=pytest.mark.slow),
    ],
)
def test_the_biharmonic_distance_tells_what_few_pairs_lack(shape, boundary, potential):
    """The mean over all sources and nodes of the squared distance, against all eigenpairs."""
    pencil = hj.assemble(flat(shape, (1.0, 1.1, 0.9)), boundary, potential=potential)
    every = hj.eigenpairs(pencil, sum(part.space.n_dof for part in pencil.parts), solver="dense")
    assert share_of_inverse_squares(every) == 0
    inverse = np.square(1 / np.asarray(every.eigenvalues)[every.n_null :])
    source = (0,) * len(shape)
    hj.biharmonic_distance(every, source)
    for k in (10, 60):
        few = hj.eigenpairs(pencil, k, solver="dense", multiplet="drop")
        lacks = inverse[int(few.kept.sum()) - every.n_null :].sum() / inverse.sum()
        assert 0.6 < share_of_inverse_squares(few) / lacks < 1.5
        if k == 10 or len(shape) == 3:
            with pytest.warns(
                hj.AccuracyWarning, match=r"pairs: got .* squared biharmonic distance .* more eigenpairs"
            ):
                hj.biharmonic_distance(few, source)
        else:
            hj.biharmonic_distance(few, source)


@pytest.mark.slow
def test_tail_estimate_is_of_the_right_size():
    field = flat((25, 26), (1.0, 1.04))
    few, many = hj.eigenpairs(field, 60), hj.eigenpairs(field, 650)
    for t in (0.01, 0.02):
        true_tail = 1 - hj.heat_trace(few, [t])[0] / hj.heat_trace(many, [t])[0]
        assert 0.5 < hj.truncation(few, [t]).tail[0] / true_tail < 2
    assert hj.truncation(hj.eigenpairs(flat((5, 5), (1, 1)), 25), [1e-3]).tail[0] == 0
    # A strip, whose sides Weyl's area term does not see, and a single pair.
    strip = flat((120, 3), (60.0, 0.02))
    few, many = hj.eigenpairs(strip, 30), hj.eigenpairs(strip, 119)
    true_tail = 1 - np.exp(-few.eigenvalues).sum() / np.exp(-many.eigenvalues).sum()
    assert 0.3 < hj.truncation(few, [1.0]).tail[0] / true_tail < 3
    alone = hj.truncation(hj.eigenpairs(flat((9, 10), (1.0, 1.0)), 1), [1.0])
    assert repr(alone).startswith("Truncation(times=float64 (1,), tail ≤ ")
    assert not alone.messages()


def incomplete_gamma(a, x):
    """What lies beyond Λ where N(λ) = 7 (λ/Λ)^a: N(Λ) Γ(a + 1) x^(−a) Q(a, x), x = Λt, by SciPy."""
    return 7 * scipy.special.gamma(a + 1) * x**-a * scipy.special.gammaincc(a, x)


@pytest.mark.parametrize("xp", [np, jnp])
@pytest.mark.parametrize("d", [2, 3])
def test_the_tail_by_weyl_in_closed_form(d, xp):
    x = np.geomspace(1e-3, 60, 40)
    tail = beyond_by_weyl(xp.asarray(7.0), d, xp.asarray(x))
    np.testing.assert_allclose(tail, incomplete_gamma(d / 2, x), rtol=1e-12)


@pytest.mark.parametrize(("least", "rtol"), [(0.1, 2e-3), (1, 2e-8), (3, 1e-12)])
def test_the_tail_for_any_exponent(least, rtol):
    x, a = np.meshgrid(np.geomspace(least, 400, 40), np.linspace(0.5, 8, 16))
    tail = beyond(jnp.asarray(7.0), jnp.asarray(a), jnp.asarray(x))
    np.testing.assert_allclose(tail, incomplete_gamma(a, x), rtol=rtol)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shape", "boundary", "spread"),
    [
        pytest.param((24, 22), "neumann", 0.0, marks=pytest.mark.slow),
        ((24, 22), ("dirichlet", "neumann"), 1.2),
        pytest.param((22, 18), "dirichlet", 0.4, marks=pytest.mark.slow),
        pytest.param((16, 18), "mirror", 1.2, marks=pytest.mark.slow),
        pytest.param((8, 9, 7), (("neumann", "dirichlet"), "periodic", "neumann"), 0.4, marks=pytest.mark.slow),
    ],
    ids=str,
)
def test_truncation_map_finds_the_worst_node(rng, shape, boundary, spread):
    mask = np.ones(shape, bool)
    mask[: shape[0] // 3, : shape[1] // 4] = boundary == "mirror"
    field = hj.TensorField(hj.Grid(shape, 0.1, mask=mask), random_spd(rng, shape, spread))
    pencil = hj.assemble(field, boundary)
    unknowns = sum(part.space.n_dof for part in pencil.parts)
    few, every = (hj.eigenpairs(pencil, k, solver="dense") for k in (unknowns // 8, unknowns))
    times = np.array([2.0, 4.6, 7.0, 14.0]) / few.next_eigenvalue
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", hj.AccuracyWarning)
        kept, whole = hj.hks(few, times), hj.hks(every, times)
    free = np.asarray(whole[0] > 0)
    missing = np.asarray(1 - kept / whole)[:, free]
    found = hj.truncation_map(few, times)
    assert found.shape == (4, *shape)
    np.testing.assert_array_equal(np.isnan(found), np.broadcast_to(~mask, found.shape))
    assert (np.asarray(found)[:, mask & ~free] == 0).all()
    ratio = missing.max(axis=1) / np.nanmax(found, axis=(*range(1, found.ndim),))
    assert (ratio > 0.25).all()
    assert (ratio[:3] < 2).all()
    assert ratio[3] < 3
    # The mean, which decides about the warning, is several times less: most of all beside Dirichlet sides.
    mean = np.asarray(hj.truncation(few, times).tail)
    assert missing[1].max() > (4 if "dirichlet" in str(boundary) else 1.2) * mean[1]
    # At half of the nodes the map is right within a factor of two.
    inner = missing[1] / np.asarray(found)[1][free]
    assert (np.quantile(inner, [0.25, 0.75]) > 0.5).all()
    assert (np.quantile(inner, [0.25, 0.75]) < 2).all()
    assert (np.nan_to_num(hj.truncation_map(every, times)) == 0).all()


@pytest.mark.parametrize("xp", [np, jnp])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_medians_are_those_of_sorting(rng, dtype, xp):
    shares = np.concatenate([rng.uniform(0, 1, (3, 41)), np.zeros((1, 41)), np.ones((1, 41))]).astype(dtype)
    free = np.arange(60) % 3 != 1  # 40 of 60; the others count as zero
    padded = np.zeros((5, 60), dtype)
    padded[:, free] = shares[:, :40]
    found = median_of_shares(xp.asarray(padded), free)
    # Of an even number, the lower of the two in the middle.
    np.testing.assert_allclose(found, np.sort(shares[:, :40], axis=1)[:, 19], rtol=3e-7, atol=1e-12)
    padded[1, 5] = np.nan
    np.testing.assert_array_equal(np.isnan(median_of_shares(xp.asarray(padded), free)), np.arange(5) == 1)


@pytest.mark.slow
def test_resolution_bias_bounds_the_discretisation_error():
    # The exact HKS of a flat torus is 1/4πt times a theta function which is 1 to 1e-10 here.
    for mass in ("consistent", "lumped"):
        field = flat((24, 24), (1.0, 1.0), (True, True))
        pairs = hj.eigenpairs(field, 576, "periodic", mass=mass)
        report = hj.truncation(pairs, jnp.array([0.01]))
        error = abs(hj.hks(pairs, [0.01], "flat")[0, 0, 0] - 1)
        assert 0.3 * report.resolution_bias[0] < error < 1.1 * report.resolution_bias[0]
        assert not report.messages()


@pytest.mark.parametrize(
    ("way", "d", "n", "ratio", "rate"),
    [
        pytest.param("linear", 2, 21, 3, 1.0, marks=pytest.mark.slow),
        pytest.param("log-euclidean", 2, 21, 3, 1.0, marks=pytest.mark.slow),
        pytest.param("linear", 2, 21, 10, 1.0, marks=pytest.mark.slow),
        pytest.param("log-euclidean", 2, 21, 10, 1.0, marks=pytest.mark.slow),
        pytest.param("linear", 2, 15, 10, 0.4, marks=pytest.mark.slow),
        pytest.param("log-euclidean", 2, 15, 10, 0.4, marks=pytest.mark.slow),
        ("linear", 3, 7, 3, 1.0),
        pytest.param("log-euclidean", 3, 7, 3, 1.0, marks=pytest.mark.slow),
    ],
)
def test_resolution_bias_of_turning_tensors_is_within_a_factor_of_three(way, d, n, ratio, rate):
    times = np.array([0.4, 1.0, 3.0])
    found = []
    for nodes in (n, 2 * n - 1):
        grid = hj.Grid.from_bounds(-1, 1, (nodes,) * d)
        pairs = hj.eigenpairs(hj.TensorField(grid, turning(grid.nodes, ratio, rate), way), 50, solver="shift-invert")
        found.append((np.asarray(hj.hks(pairs, times)), hj.truncation(pairs, times)))
    (coarse, report), (fine, _) = found
    assert report.tail.max() < 0.01
    # Of second order: the finer grid has a quarter of the error.
    error = 4 / 3 * (coarse / fine[(slice(None), *[slice(None, None, 2)] * d)] - 1)
    median = np.median(np.abs(error), axis=tuple(range(1, d + 1)))
    clear = median > 5e-4
    assert clear.sum() >= 2
    ratios = np.asarray(report.resolution_bias)[clear] / median[clear]
    assert (ratios > 1 / 3).all(), ratios
    assert (ratios < 3).all(), ratios


@pytest.mark.parametrize(("quadrature", "truth"), [("gauss", [0.01602, 0.00746, 0.00566, 0.00498]),
                                                    ("cancelling", [0.0024, 0.00131, 0.00297, 0.00249])])  # fmt: skip
def test_the_bias_of_an_uneven_volume_element(quadrature, truth):
    # The median errors at t = 3, 6, 12 and 24 h² are relative to an extrapolation from grids four and eight times as
    # fine. The flux of a conformal metric does not vary, and the mean of the volume's error is zero.
    grid = hj.Grid((13, 13), 1 / 13)
    factor = np.exp(2 * np.exp(-20 * np.sum((grid.nodes - 0.5) ** 2, axis=-1)))
    pencil = hj.assemble(hj.TensorField(grid, factor[..., None, None] * np.eye(2)), "periodic", quadrature=quadrature)
    report = hj.truncation(hj.eigenpairs(pencil, 169, solver="dense"), np.array([3, 6, 12, 24]) / 13**2)
    ratios = np.array(truth) / np.asarray(report.resolution_bias)
    assert (ratios > 0.15).all(), ratios
    assert (ratios < 1.5).all(), ratios


@pytest.mark.filterwarnings("ignore::hks_jax.AccuracyWarning")
@pytest.mark.parametrize("mass", ["consistent", "lumped"])
def test_the_bias_between_dirichlet_sides_grows_with_t(mass):
    # On the unit square, the signature at large t is that of the lowest mode: 4 sin²(πx) sin²(πy) exp(−2π²t).
    n = 15
    field = flat((n, n), (1.0, 1.0))
    pairs = hj.eigenpairs(field, 60, "dirichlet", "dense", mass)
    times = np.array([0.2, 0.5, 1.0])
    sines = np.sin(np.pi * np.linspace(0, 1, n))[1:-1] ** 2
    exact = 4 * sines[:, None] * sines * np.exp(-2 * np.pi**2 * times)[:, None, None]
    error = np.median(np.abs(np.asarray(hj.hks(pairs, times))[:, 1:-1, 1:-1] / exact - 1), axis=(1, 2))
    ratios = np.asarray(hj.truncation(pairs, times).resolution_bias) / error
    assert (ratios > 0.5).all(), ratios
    assert (ratios < 3).all(), ratios


@pytest.mark.filterwarnings("ignore::hks_jax.AccuracyWarning")
@pytest.mark.slow
def test_truncation_map_of_a_thin_strip():
    # The lowest modes vary along one axis only; where those along the other axis begin, the spectrum has a gap.
    field = hj.TensorField(hj.Grid.from_bounds(0, 1, (16, 16)), np.broadcast_to(np.diag([1e4, 1.0]), (16, 16, 2, 2)))
    pencil = hj.assemble(field)
    whole = hj.eigenpairs(pencil, 256, solver="dense")
    for k in (16, 24, 32):
        few = hj.eigenpairs(pencil, k, solver="dense")
        times = np.array([2.0, 4.6]) / float(few.next_eigenvalue)
        missing = np.asarray(1 - hj.hks(few, times) / hj.hks(whole, times)).max(axis=(1, 2))
        ratios = missing / np.asarray(hj.truncation_map(few, times)).max(axis=(1, 2))
        assert (ratios > 0.15).all(), (k, ratios)
        assert (ratios < 4).all(), (k, ratios)


def test_the_least_resolved_time_does_not_depend_on_the_times():
    """The lasting part, about 8 % here, is no part of it."""
    grid = hj.Grid.from_bounds(-1.0, 1.0, (13, 13))
    angle = 2 * grid.nodes[..., 0] + grid.nodes[..., 1]
    turn = np.moveaxis(np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]), (0, 1), (-2, -1))
    pairs = hj.eigenpairs(hj.TensorField(grid, turn @ np.diag([10.0, 1.0]) @ np.swapaxes(turn, -1, -2)), 169)
    estimates = [hj.truncation(pairs, times) for times in ([0.02, 20.0], [20.0, 0.02], [100.0])]
    assert estimates[2].lasting_bias[0] > 0.05
    least = [float(each.smallest_resolved) for each in estimates]
    np.testing.assert_allclose(least, least[0])
    at_least = hj.truncation(pairs, [least[0]])
    decreasing = at_least.resolution_bias[0] - at_least.lasting_bias[0]
    assert 0 < decreasing < 0.1


def test_tensors_that_do_not_turn_have_no_lasting_bias(rng):
    mask = np.ones((9, 8), dtype=bool)
    mask[:3, 4:] = False
    grid = hj.Grid((9, 8), 0.1, mask=mask)
    constant = np.where(mask[..., None, None], np.array([[4.0, 1.0], [1.0, 2.0]]), np.eye(2))
    # A conformal factor does not stretch the flux of a plane, and log-Euclidean interpolation of exp(x + 2y) is exact.
    conformal = np.exp(grid.nodes @ [1.0, 2.0])[..., None, None] * np.eye(2)
    for field in (hj.TensorField(grid, constant), hj.TensorField(grid, conformal, "log-euclidean")):
        resolution = hj.assemble(field).resolution
        np.testing.assert_allclose(np.asarray(resolution.turning)[mask], 0, atol=1e-14)
        np.testing.assert_allclose(resolution.swelling, 0, atol=1e-14)
    periodic = hj.assemble(flat((6, 5), (1.0, 2.0), (True, True)), "periodic").resolution
    # h²/48 on each axis, in the units of the metric.
    np.testing.assert_allclose(periodic.dispersion, ((1 / 6) ** 2 + (2 / 5) ** 2) / 48, rtol=1e-12)
    turned = hj.TensorField(hj.Grid((21, 21), 0.1), turning(hj.Grid((21, 21), 0.1).nodes, 10.0, 1.0))
    exact = hj.assemble(hj.TensorField(turned.grid, turned.tensors, "log-euclidean"))
    swollen = hj.assemble(turned)
    assert exact.volume == pytest.approx(4 * np.sqrt(10))
    assert exact.resolution.swelling < 1e-12
    assert swollen.resolution.swelling == pytest.approx(float(swollen.volume / exact.volume - 1), rel=0.1)


def test_a_bias_that_lasts_is_reported_with_its_remedy():
    grid = hj.Grid.from_bounds(-1, 1, (11, 11))
    pairs = hj.eigenpairs(hj.TensorField(grid, turning(grid.nodes, 20.0, 1.0)), 121)
    (message,) = hj.truncation(pairs, [3.0, 10.0]).messages()
    assert "2 of 2 times" in message
    assert 'larger times do not reduce. Use a finer grid; interpolation="log-euclidean"' in message
    assert "Use times of" not in message


def test_too_small_times_are_reported():
    pairs = hj.eigenpairs(flat((30, 31), (1.0, 1.0)), 60)
    with pytest.warns(
        hj.AccuracyWarning,
        match=r"1 of 2 times are too small for k: on average .* an estimated .*% of the signature .*truncation_map",
    ) as seen:
        hj.hks(pairs, [0.004, 0.5])
    assert [warning.filename for warning in seen] == [__file__]
    whole = hj.eigenpairs(flat((8, 9), (1.0, 1.0)), 72)
    with pytest.warns(
        hj.AccuracyWarning, match="too small for the grid: .* Use times of at least about .* or a finer grid"
    ):
        hj.hks(whole, [0.004])
    # The advice is the same whatever the time, and enough.
    said = [hj.truncation(whole, [t]).messages()[0] for t in (1e-6, 1e-3, 4e-3)]
    (least,) = {float(re.search(r"at least about (\S+),", text)[1]) for text in said}
    assert 0.09 < hj.truncation(whole, [least]).resolution_bias[0] < 0.105
    smallest = hj.truncation(pairs, [0.5]).smallest_time
    assert hj.truncation(pairs, smallest[None]).tail[0] < 0.011
    # The diffusion distance at t contains the kernel at 2t.
    half = f"t = 0.002 lies .* at least about {smallest / 2:.4g}"
    with pytest.warns(hj.AccuracyWarning, match=half):
        hj.diffusion_distance(pairs, [0.002], (3, 4))


@pytest.mark.parametrize(
    ("times", "message"),
    [
        ([0.1, 0.0], "times: got 0.0; expected positive finite"),
        ([-1.0], "times: got -1.0"),
        ([np.nan], "times: got nan"),
        ([[0.1]], r"times: got shape \(1, 1\); expected a number or a non-empty 1-D array"),
        ([], "times: got shape"),
    ],
)
def test_bad_times(pairs, times, message):
    for function in (hj.hks, hj.heat_trace, hj.truncation, hj.truncation_map):
        with unchecked(), pytest.raises(ValueError, match=message):
            function(pairs, times)


@pytest.mark.parametrize(
    ("sources", "message"),
    [
        ((0, 8), r"sources: got 1 of 1 nodes outside the mask \(the first is \(0, 8\)\)"),
        ((0, 9), "sources: got indices 0 … 9; expected nodes of shape"),
        ((0.0, 1.0), "expected integer node indices"),
        ([1, 2, 3], r"sources: got shape \(3,\); expected \(s, 2\) node indices"),
    ],
)
def test_bad_sources(pairs, sources, message):
    with pytest.raises(ValueError, match=message):
        hj.heat_kernel(pairs, [0.5], sources)


@pytest.mark.slow
def test_shape_dna_of_pairs_that_are_not_kept_has_a_gradient():
    field = hj.TensorField(hj.Grid((12, 12), 1 / 11), jnp.broadcast_to(jnp.eye(2), (12, 12, 2, 2)))

    def value(tensors):
        pairs = hj.eigenpairs(hj.TensorField(field.grid, tensors), 6, multiplet="complete")
        assert not pairs.kept.all()
        return jnp.nansum(hj.shape_dna(pairs))

    change = jnp.linspace(0, 1, 144).reshape(12, 12, 1, 1) ** 2 * field.tensors
    along = jax.jvp(value, (field.tensors,), (change,))[1]
    np.testing.assert_allclose(jnp.vdot(jax.grad(value)(field.tensors), change), along, rtol=1e-9)


def test_other_bad_arguments(pairs):
    with pytest.raises(ValueError, match="energies, sigma: got only one; expected both"):
        hj.wks(pairs, [1.0])
    with pytest.raises(ValueError, match="sigma: got 0"):
        hj.wks(pairs, [1.0], np.float32(0))
    with pytest.raises(ValueError, match=r"energies: got .*nan"):
        hj.wks(pairs, [np.nan], 1.0)
    with pytest.raises(ValueError, match="expected at least two"):
        hj.wks(hj.eigenpairs(flat((5, 6), (1.0, 1.2)), 2))
    with pytest.raises(ValueError, match="times: got 'soon'"):
        hj.hks(pairs, "soon")
    squares = np.ones((4, 9), dtype=bool)
    squares[:, 4] = False
    apart = hj.TensorField(hj.Grid((4, 9), mask=squares, components="all"), np.broadcast_to(np.eye(2), (4, 9, 2, 2)))
    with pytest.raises(ValueError, match=r"pairs: got eigenpairs of 2 components.* infinite"):
        hj.biharmonic_distance(hj.eigenpairs(apart, 32), (0, 0))
    with pytest.raises(ValueError, match=r"pairs: got eigenpairs of 2 components.* infinite"):  # one of them is pinned
        hj.biharmonic_distance(hj.eigenpairs(apart, 20, ("neumann", ("dirichlet", "neumann"))), (0, 8))
    with pytest.raises(ValueError, match="n_frequencies: got 200; expected 1 to 129 for 256 times"):
        hj.scale_invariant_hks(pairs, 200)
    with pytest.raises(ValueError, match="n: got 0"):
        hj.default_times(pairs, 0)
    alone = hj.eigenpairs(flat((5, 6), (1.0, 1.2)), 1)
    with pytest.raises(ValueError, match="got 1 eigenvalues, none positive"):
        hj.default_times(alone)


def test_batches_and_other_objects_are_refused(field, pairs):
    batch = jax.vmap(lambda T: hj.eigenpairs(hj.TensorField(field.grid, T), 5))(jnp.stack([field.tensors] * 3))
    for function in (hj.hks, hj.heat_trace, hj.truncation, hj.truncation_map):
        with pytest.raises(ValueError, match=r"pairs: got a batch with eigenvalues of shape \(3, 5\).*jax.vmap"):
            function(batch, [1.0, 2.0, 3.0])
        with unchecked(), pytest.raises(TypeError, match="pairs: got TensorField; expected the result of `eigenpairs`"):
            function(field, [1.0])
    each = jax.vmap(lambda p: hj.heat_trace(p, jnp.array([1.0, 2.0])))(batch)
    np.testing.assert_allclose(each[0], hj.heat_trace(hj.eigenpairs(field, 5), [1.0, 2.0]), rtol=1e-10)


def test_everything_runs_under_jit(field):
    @jax.jit
    def everything(field, times):
        pairs = hj.eigenpairs(field, 16, solver="dense")
        return (
            hj.hks(pairs, times), hj.wks(pairs), hj.scale_invariant_hks(pairs), hj.heat_trace(pairs, times),
            hj.heat_kernel(pairs, times, (4, 4)), hj.diffusion_distance(pairs, times, (4, 4)),
            hj.biharmonic_distance(pairs, (4, 4)), hj.default_times(pairs), hj.truncation(pairs, times).tail,
            hj.shape_dna(pairs), hj.global_point_signature(pairs), hj.truncation_map(pairs, times),
        )  # fmt: skip

    times = jnp.array([1.0, 2.0])
    pairs = hj.eigenpairs(field, 16, solver="dense")
    traced = everything(field, times)
    np.testing.assert_allclose(traced[0], hj.hks(pairs, times), rtol=1e-10)
    np.testing.assert_allclose(traced[6], hj.biharmonic_distance(pairs, (4, 4)), rtol=1e-8, atol=1e-7)
    assert [np.isfinite(leaf).any() for leaf in traced] == [True] * 12
