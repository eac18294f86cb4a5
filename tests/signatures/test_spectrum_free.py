"""Signatures without eigenpairs against all eigenpairs, their bounds, derivatives, and the choice between methods."""

from dataclasses import replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from annotations import unchecked
from differences import directional
from fields import flat, random_spd
from scipy.special import ive

import hks_jax as hj
from hks_jax.fem.boundary import normalise_boundary
from hks_jax.fem.space import GridSpace
from hks_jax.linear.chebyshev import chebyshev_heat_coefficients, coefficient_tails
from hks_jax.spectrum_free.plan import choose_method, work
from hks_jax.spectrum_free.rational import exponential_poles
from hks_jax.spectrum_free.spectrum_bounds import bounds, mass_bound

MIXED = (("neumann", "dirichlet"), "periodic")


def random_field(shape, mask=None, seed=5):
    return hj.TensorField(hj.Grid(shape, 0.1, mask=mask), random_spd(np.random.default_rng(seed), shape, 0.4))


def l_shape(shape):
    mask = np.ones(shape, bool)
    mask[: shape[0] // 2, : shape[1] // 3] = False
    return mask


def by_all_pairs(pencil, times):
    """The signature from SciPy's dense solver."""
    parts = []
    for part in pencil.parts:
        values, vectors = scipy.linalg.eigh(part.stiffness.to_dense(), part.mass.to_dense())
        decay = np.exp(-np.multiply.outer(np.asarray(times), values))
        parts.append(part.space.extend(jnp.asarray(decay @ vectors.T**2)))
    return np.mean(parts, axis=0)


def flat_scale(times, d):
    return (4 * np.pi * np.asarray(times)).reshape(-1, *[1] * d) ** (-d / 2)


@pytest.mark.parametrize(
    ("shape", "boundary", "mass", "times"),
    [
        pytest.param((26, 23), "neumann", "lumped", [0.005, 0.01], marks=pytest.mark.slow),
        pytest.param((26, 23), MIXED, "consistent", [0.005, 0.01], marks=pytest.mark.slow),
        pytest.param((14, 12), "mirror", "lumped", [0.01], marks=pytest.mark.slow),
        pytest.param((6, 7, 5), "neumann", "consistent", [0.005], marks=pytest.mark.slow),
        ((9, 10, 8), ("periodic", "dirichlet", "neumann"), "lumped", [0.005, 0.02]),
    ],
    ids=str,
)
def test_colouring_keeps_its_bound(shape, boundary, mass, times):
    mask = l_shape(shape) if shape[1] > 12 else None
    pencil = hj.assemble(random_field(shape, mask), boundary, mass)
    settings = hj.colouring(pencil, times, tolerance=1e-5)
    values = hj.hks_spectrum_free(pencil, times, method=settings)
    expected = by_all_pairs(pencil, times)
    np.testing.assert_array_equal(np.isnan(values), np.isnan(expected))
    error = np.nanmax(np.abs(values - expected) / flat_scale(times, len(shape)), axis=tuple(range(1, len(shape) + 1)))
    assert (error <= np.array(settings.error) + 1e-12).all()
    assert max(settings.error) <= 1e-5


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mass", "sigma", "seed"),
    [
        ("lumped", 2.5, 1),
        pytest.param("consistent", 6.0, 2, marks=pytest.mark.slow),
        pytest.param("lumped", 6.0, 2, marks=pytest.mark.slow),
        pytest.param("consistent", 2.5, 1, marks=pytest.mark.slow),
    ],
)
def test_the_bound_holds_on_rough_fields_and_in_single_precision(mass, sigma, seed):
    """Log-determinants that jump by σ from node to node, against all pairs."""
    shape = (16, 14)
    rng = np.random.default_rng(seed)
    tensors = np.exp(sigma / 2 * rng.standard_normal(shape))[..., None, None] * random_spd(rng, shape, 0.4)
    field = hj.TensorField(hj.Grid(shape, 0.1), tensors)
    pencil, times = hj.assemble(field, "neumann", mass), [1e-5, 1e-4, 0.002]
    exact = by_all_pairs(pencil, times)
    scale = np.minimum(flat_scale(times, 2), 1 / float(jnp.max(jnp.sum(pencil.mass.to_dense(), axis=1))))
    for dtype, tolerance in ((jnp.float64, 1e-2), (jnp.float64, 1e-6), (jnp.float32, 0.05)):
        some = hj.assemble(hj.TensorField(field.grid, jnp.asarray(tensors, dtype)), "neumann", mass)
        settings = hj.colouring(some, times, tolerance=tolerance)
        error = np.abs(np.asarray(hj.hks_spectrum_free(some, times, method=settings)) - exact) / scale
        # 1e-10: a dense eigendecomposition has its own rounding, relative to values 10⁴ times the scale.
        assert (error.max(axis=(1, 2)) <= np.array(settings.error) + 1e-10).all()
        assert max(settings.error) <= tolerance


@pytest.mark.slow
def test_tolerances_below_rounding_are_refused():
    field = random_field((16, 15))
    single = hj.TensorField(field.grid, jnp.asarray(field.tensors, jnp.float32))
    for mass in ("lumped", "consistent"):
        with pytest.raises(
            ValueError,
            match=r"tolerance: got 1e-07, below the rounding error .* float32 .* Use a tolerance of at least",
        ) as told:
            hj.colouring(single, [0.005], mass=mass, tolerance=1e-7)
        least = float(str(told.value).split("tolerance of at least ")[1].split(",")[0])
        settings = hj.colouring(single, [0.005], mass=mass, tolerance=1.01 * least)
        pencil = hj.assemble(field, "neumann", mass)
        error = np.abs(
            np.asarray(hj.hks_spectrum_free(single, [0.005], mass=mass, method=settings))
            - by_all_pairs(pencil, [0.005])
        )
        assert 0.003 * least < error.max() / flat_scale([0.005], 2).max() <= settings.error[0] <= 1.01 * least
    # The other method has no such tolerance.
    assert np.isfinite(hj.hks_spectrum_free(single, [0.005], tolerance=1e-7)).all()


@pytest.mark.slow
def test_few_vectors_serve_a_large_grid_and_the_bound_is_not_absurd():
    field, t = flat((64, 60), (1.0, 1.0), (False, True)), 3 / 63**2
    pencil = hj.assemble(field, ("neumann", "periodic"), "lumped")
    settings = hj.colouring(pencil, [t])
    exact = hj.hks_spectrum_free(pencil, [t], method="selected-inversion")
    error = float(jnp.max(jnp.abs(hj.hks_spectrum_free(pencil, [t], method=settings) - exact))) * 4 * np.pi * t
    assert settings.n_vectors(pencil.space) < 64 * 60 / 8
    assert error <= settings.error[0] <= 1e-4
    # The constant of the bound is 1/D where it could be the kernel's diagonal, 4πt/h² = 38 times less.
    assert settings.error[0] < 5000 * error
    # Three quarters of the spacing do not keep the tolerance by much: the choice is not wasteful.
    near = replace(settings, spacing=tuple(s // 2 for s in settings.spacing))
    assert float(jnp.max(jnp.abs(hj.hks_spectrum_free(pencil, [t], method=near) - exact))) * 4 * np.pi * t > 1e-4


@pytest.mark.parametrize(
    ("shape", "boundary", "mass"),
    [
        ((13, 12), "neumann", "consistent"),
        pytest.param((9, 8), ("periodic", "periodic"), "consistent", marks=pytest.mark.slow),
        pytest.param((8, 9), ("periodic", "periodic"), "lumped", marks=pytest.mark.slow),
        pytest.param((8, 11), ("periodic", ("dirichlet", "neumann")), "consistent", marks=pytest.mark.slow),
        pytest.param((8, 7), "mirror", "lumped", marks=pytest.mark.slow),
        pytest.param(
            (6, 5, 7), ("neumann", "periodic", ("dirichlet", "neumann")), "consistent", marks=pytest.mark.slow
        ),
    ],
    ids=str,
)
def test_selected_inversion_is_exact_at_any_time(shape, boundary, mass):
    mask = l_shape(shape) if boundary == "neumann" else None
    late = 1.0 if "dirichlet" in str(boundary) else 10.0
    pencil, times = hj.assemble(random_field(shape, mask), boundary, mass), [1e-4, 0.01, late]
    values = hj.hks_spectrum_free(pencil, times, method="selected-inversion")
    np.testing.assert_allclose(values, by_all_pairs(pencil, times), rtol=1e-8, atol=1e-8)


@cache
def derivatives_by_all_pairs(mass):
    """A loss on the signature of all pairs, its gradient, and its derivative by time."""
    field, times = random_field((9, 10)), jnp.array([0.01, 0.03])
    probe = np.random.default_rng(1).standard_normal((2, 9, 10))

    def loss(tensors, times):
        pairs = hj.eigenpairs(hj.TensorField(field.grid, tensors), 90, "neumann", "dense", mass)
        return jnp.sum(probe * hj.hks(pairs, times))

    return field, times, probe, *jax.grad(loss, (0, 1))(field.tensors, times)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::hks_jax.AccuracyWarning")
@pytest.mark.parametrize(
    ("method", "mass"),
    [
        ("colouring", "lumped"),
        pytest.param("colouring", "consistent", marks=pytest.mark.slow),
        pytest.param("selected-inversion", "consistent", marks=pytest.mark.slow),
    ],
)
def test_derivatives(method, mass):
    field, times, probe, of_tensors, of_times = derivatives_by_all_pairs(mass)

    def loss(tensors, times):
        moved = hj.TensorField(field.grid, tensors)
        return jnp.sum(probe * hj.hks_spectrum_free(moved, times, mass=mass, method=method, tolerance=1e-9))

    slope, slope_times = jax.grad(loss, (0, 1))(field.tensors, times)
    np.testing.assert_allclose(slope, of_tensors, atol=1e-7 * np.abs(of_tensors).max())
    np.testing.assert_allclose(slope_times, of_times, rtol=1e-7)
    direction = jnp.asarray(random_spd(np.random.default_rng(2), (9, 10)))
    _, forward = jax.jvp(lambda T: loss(T, times), (field.tensors,), (direction,))
    np.testing.assert_allclose(forward, jnp.vdot(of_tensors, direction), rtol=1e-7)
    if method == "selected-inversion":
        # Without any eigensolver: central differences.
        found = directional(lambda T: loss(T, times), field.tensors, direction, 1e-3)
        np.testing.assert_allclose(forward, found, rtol=1e-7)


@pytest.mark.slow
def test_memory_of_a_gradient_does_not_grow_with_the_degree():
    field, times = random_field((20, 22)), jnp.array([0.01])
    settings = hj.colouring(field, times, mass="lumped")

    def bytes_of(degree):
        chosen = replace(settings, degree=degree)

        def loss(tensors):
            moved = hj.TensorField(field.grid, tensors)
            return jnp.sum(hj.hks_spectrum_free(moved, times, mass="lumped", method=chosen))

        memory = jax.jit(jax.grad(loss)).lower(field.tensors).compile().memory_analysis()
        return memory.temp_size_in_bytes

    one_block = 20 * 22 * settings.columns * 8
    assert bytes_of(200) - bytes_of(20) < one_block


@pytest.mark.slow
def test_traced_values_need_settings_and_settings_must_fit():
    field, times = random_field((9, 10)), jnp.array([0.01])

    def loss(scale, **more):
        moved = hj.TensorField(field.grid, scale * field.tensors)
        return jnp.sum(hj.hks_spectrum_free(moved, times, mass="lumped", **more))

    with pytest.raises(ValueError, match=r"hks_jax\.colouring"):
        jax.jit(lambda s: loss(s, method="colouring"))(1.0)
    # Traced, selected inversion needs no settings.
    settings = hj.colouring(field, times, mass="lumped", tolerance=1e-9)
    exact = jax.jit(loss)(1.0)
    # On a metric half as large, lengths are shorter and the spectrum is larger than the settings are for.
    slopes = jax.vmap(jax.value_and_grad(lambda s: loss(s, method=settings)))(jnp.array([1.0, 1.01, 0.5]))
    np.testing.assert_allclose(slopes[0][0], exact, rtol=1e-9)
    assert np.isfinite(slopes[0][:2]).all()
    assert np.isfinite(slopes[1][:2]).all()
    assert np.isnan(slopes[0][2])
    assert np.isnan(slopes[1][2])
    with pytest.raises(NotImplementedError, match="second derivatives"):
        jax.grad(jax.grad(lambda s: loss(s, method=settings)))(1.0)


def constant(n, c=1.0):
    """The metric c·I on n × n nodes at distances √c."""
    return hj.TensorField(hj.Grid((n, n)), np.broadcast_to(c * np.eye(2), (n, n, 2, 2)))


@pytest.mark.slow
def test_a_colouring_serves_no_times_beyond_those_planned():
    """Four times the metric and the time: heat reaches as many nodes as planned, but the degree is too small."""
    settings = hj.colouring(constant(24), [4.0], mass="lumped")

    @jax.jit
    def signature(c, times):
        domain = hj.TensorField(hj.Grid((24, 24)), c * constant(24).tensors)
        return hj.hks_spectrum_free(domain, times, mass="lumped", method=settings)

    exact = hj.hks_spectrum_free(constant(24, 4.0), [4.0], mass="lumped", method="selected-inversion")
    np.testing.assert_allclose(signature(4.0, jnp.array([4.0])), exact, atol=1e-4 / (16 * np.pi))
    assert np.isnan(signature(4.0, jnp.array([16.0]))).all()
    with pytest.warns(hj.AccuracyWarning, match=r"method: got a Colouring for times up to 4; .* up to 16, .*all times"):
        found = hj.hks_spectrum_free(constant(24, 4.0), [16.0], mass="lumped", method=settings)
    assert np.isnan(found).all()
    with pytest.warns(hj.AccuracyWarning, match="for times up to 4; .* up to 16, "):
        jax.grad(lambda t: signature.__wrapped__(4.0, t)[0, 0, 0])(jnp.array([16.0]))


def test_a_colouring_serves_no_larger_grid():
    """One source on 8 nodes has no other source of its colour; on 16 nodes it has one at the distance 8."""
    settings = hj.colouring(constant(8), [20.0], mass="lumped", slack=1.5)
    call = partial(hj.hks_spectrum_free, mass="lumped", method=settings)
    message = r"method: got a Colouring for a grid of the shape \(8, 8\); expected .* the shape \(16, 16\)"
    with pytest.raises(ValueError, match=message):
        call(constant(16), [20.0])
    with pytest.raises(ValueError, match=message):
        jax.jit(lambda t: call(constant(16), t))(jnp.array([20.0]))
    exact = hj.hks_spectrum_free(constant(7), [20.0], mass="lumped", method="selected-inversion")
    np.testing.assert_allclose(call(constant(7), [20.0]), exact, atol=1e-4 / (80 * np.pi))


@pytest.mark.parametrize("boundary", ["neumann", "dirichlet"])
def test_a_colouring_for_another_metric_or_mass_is_told_with_the_remedy(boundary):
    """On half the metric the spectrum is twice as large. Dirichlet conditions once gave another cause."""
    settings = hj.colouring(constant(12), [2.0], boundary, mass="lumped")
    with pytest.warns(hj.AccuracyWarning) as told:
        found = hj.hks_spectrum_free(constant(12, 0.5), [2.0], boundary, mass="lumped", method=settings)
    assert np.isnan(found).all()
    (message,) = [str(each.message) for each in told]
    assert message.startswith("method: the largest eigenvalue or the reach of heat on this domain is 2")
    slack = float(message.split("with a slack ")[1].split(" times")[0])
    assert 2 <= slack < 2.05
    wider = hj.colouring(constant(12), [2.0], boundary, mass="lumped", slack=slack)
    if boundary == "neumann":
        exact = hj.hks_spectrum_free(constant(12, 0.5), [2.0], mass="lumped", method="selected-inversion")
        found = hj.hks_spectrum_free(constant(12, 0.5), [2.0], mass="lumped", method=wider)
        np.testing.assert_allclose(found, exact, atol=1e-4 / (8 * np.pi))
    else:
        with pytest.warns(hj.AccuracyWarning, match="a mass with weaker couplings"):
            hj.hks_spectrum_free(constant(12), [1.0], boundary, method=settings)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["selected-inversion", "colouring"])
def test_amplified_errors_give_nan(method):
    """Errors grow as exp(−vt) with the least potential v; for a constant potential the signature grows as fast."""
    field = flat((8, 7), (1.4, 1.2))
    well = hj.assemble(field, potential=np.where(np.arange(56) == 25, -60.0, 0.0).reshape(8, 7), mass="lumped")
    pairs = hj.eigenpairs(well, 56, solver="dense")
    assert abs(pairs.eigenvalues[0]) < 10
    times = [0.05, 1.0]
    with pytest.warns(hj.AccuracyWarning, match="the signatures at 1 of 2 times, the first 1, are NaN"):
        found = hj.hks_spectrum_free(well, times, method=method)
    np.testing.assert_allclose(found[0], hj.hks(pairs, times)[0], rtol=1e-3)
    assert np.isnan(found[1]).all()
    if method == "selected-inversion":
        traced = jax.jit(lambda t: hj.hks_spectrum_free(well, t, method=method))(jnp.array(times))
        np.testing.assert_allclose(traced, found, rtol=1e-9)
    if method == "selected-inversion":
        single = hj.TensorField(field.grid, field.tensors.astype(np.float32))
        with pytest.warns(hj.AccuracyWarning, match="at 1 of 2 times, the first 1e\\+06, are NaN, because .* float32"):
            found = hj.hks_spectrum_free(single, [10.0, 1e6], method=method)
        np.testing.assert_allclose(found[0], 1 / 1.68, rtol=1e-3)
        assert np.isnan(found[1]).all()
    deep = hj.assemble(field, potential=-60.0, mass="lumped")
    growing = hj.hks_spectrum_free(deep, times, method=method)
    np.testing.assert_allclose(growing, hj.hks(hj.eigenpairs(deep, 56, solver="dense"), times), rtol=1e-3)
    # With Dirichlet conditions the signature at t = 5 is 1e-25, far below the error.
    with pytest.warns(hj.AccuracyWarning, match="the signatures at 1 of 2 times, the first 5, are NaN"):
        found = hj.hks_spectrum_free(field, [0.2, 5.0], "dirichlet", "lumped", method)
    with pytest.warns(hj.AccuracyWarning, match="the signatures at 1 of 2 times, the first 5, are NaN"):
        jax.grad(lambda t: jnp.nansum(hj.hks_spectrum_free(field, t, "dirichlet", "lumped", method)))(
            jnp.array([0.2, 5.0])
        )
    # The lowest eigenvalue is 6 % too small, which makes 14 % of the signature at λt = 2.4.
    with pytest.warns(hj.AccuracyWarning, match="between Dirichlet sides, few modes remain"):
        exact = hj.hks(hj.eigenpairs(field, 30, "dirichlet", "dense", "lumped"), [0.2])[0]
    np.testing.assert_allclose(found[0], exact, rtol=1e-2, atol=1e-5)
    assert np.isnan(found[1, 1:-1, 1:-1]).all()


@pytest.mark.slow
def test_float32():
    shape, times = (24, 22), [0.005, 0.01]
    field = random_field(shape)
    single = hj.TensorField(field.grid, jnp.asarray(field.tensors, jnp.float32))
    exact = hj.hks_spectrum_free(field, times, mass="lumped", method="selected-inversion")
    for method in ("colouring", "selected-inversion"):
        values = hj.hks_spectrum_free(single, times, mass="lumped", method=method)
        assert values.dtype == jnp.float32
        np.testing.assert_allclose(values, exact, rtol=5e-4)


def test_bounds_hold():
    for shape, mass in (((12, 11), "consistent"), ((6, 7, 6), "lumped")):
        pencil = hj.assemble(random_field(shape), "neumann", mass)
        K, M = pencil.stiffness.to_dense(), pencil.mass.to_dense()
        low = mass_bound(pencil)
        true_low = scipy.linalg.eigvalsh(M, np.diag(np.sum(M, axis=1)))[0]
        assert 0.9 * true_low - 0.02 <= low <= true_low + 1e-12
        top, true_top = bounds(pencil, low, 40 if mass == "consistent" else 1).top, scipy.linalg.eigvalsh(K, M)[-1]
        assert true_top * (1 - 1e-6) <= top <= 1.35 * true_top


def test_coefficients_and_poles():
    times, top = jnp.array([0.1, 7.0]), 9.0
    found = chebyshev_heat_coefficients(times, top, 80)
    for row, t in zip(found, np.asarray(times), strict=True):
        n = np.arange(81)
        np.testing.assert_allclose(np.abs(row), np.where(n == 0, 1, 2) * ive(n, t * top / 2), atol=1e-14)
        assert coefficient_tails(t * top / 2)[-2] < 1e-20
    x = np.append(0, np.geomspace(1e-4, 1e6, 2001))
    for pairs, error in ((1, 2e-2), (3, 3e-6), (5, 3e-10), (7, 2e-13)):
        poles, weights = exponential_poles(pairs)
        assert poles.size == pairs
        assert np.abs(np.sum(weights / (x[:, None] - poles), axis=1).real - np.exp(-x)).max() < error


def test_sources_of_a_colour_are_apart_also_around_a_periodic_axis():
    space = GridSpace(hj.Grid((23, 17)), normalise_boundary(("periodic", "neumann"), 2))
    settings = hj.Colouring((5, 4), 1, 1, 1, 1.0, 1.0, (1.0, 1.0), (0.0, 0.0), (23, 17), 1.0, (0.0,))
    colours = settings.colours(space).value
    assert set(np.unique(colours)) == set(range(colours.max() + 1))
    for colour in range(colours.max() + 1):
        i, j = np.nonzero(colours == colour)
        apart = np.abs(i[:, None] - i)
        far = (np.minimum(apart, 23 - apart) >= 5) | (np.abs(j[:, None] - j) >= 4)
        assert far[~np.eye(i.size, dtype=bool)].all()


@pytest.mark.slow
def test_auto_takes_each_time_from_the_method_that_reaches_it(monkeypatch):
    field, times = random_field((24, 22)), [0.02, 0.5, 1.0]
    pairs = hj.eigenpairs(field, 60)
    found = hj.hks_auto(pairs, times)
    expected = by_all_pairs(pairs.pencil, times)
    np.testing.assert_array_equal(found.spectral, [False, True, True])
    np.testing.assert_allclose(found.values, expected, rtol=1e-3)
    assert float(found.overlap_time) == 0.5
    assert float(found.overlap_difference) < 1e-4
    assert "1 of 3 times use selected-inversion: 0.02" in found.summary()
    assert "at t = 0.5 the signatures with and without eigenpairs differ" in found.summary()
    flat = hj.hks_auto(pairs, times[:1], "flat").values
    np.testing.assert_allclose(flat[0], expected[0] * 4 * np.pi * times[0], rtol=1e-3)
    assert hj.hks_auto(pairs, times[1:]).method == "none"
    with pytest.raises(ValueError, match="traced"):
        jax.jit(lambda t: hj.hks_auto(pairs, t).values)(jnp.array(times))
    with pytest.raises(ValueError, match="heat-trace"):
        hj.hks_auto(pairs, times, "heat-trace")
    monkeypatch.setattr("hks_jax.signatures.hks_auto._DEARER", 0.0)  # no comparison is cheap enough
    found = hj.hks_auto(pairs, times)
    assert np.isnan(found.overlap_time)
    assert "differ" not in found.summary()


@pytest.mark.filterwarnings("ignore::hks_jax.AccuracyWarning")
@pytest.mark.slow
def test_auto_on_a_mesh_and_in_a_volume():
    for domain, k in ((hj.examples.bumpy_torus_mesh(12), 30), (random_field((6, 7, 8)), 40)):
        pairs = hj.eigenpairs(domain, k, solver="dense")
        times = jnp.array([0.2, 20.0]) / float(pairs.next_eigenvalue)
        found = hj.hks_auto(pairs, times)
        np.testing.assert_array_equal(found.spectral, [False, True])
        np.testing.assert_allclose(found.values, by_all_pairs(pairs.pencil, times), rtol=1e-4)
        assert found.method == "selected-inversion"
        assert float(found.overlap_difference) < 1e-4


@pytest.mark.slow
def test_a_volume_too_large_for_selected_inversion_is_left_to_colouring(monkeypatch):
    """Decided by the number of nodes alone: to dissect them would take long."""
    pencil, times = hj.assemble(flat((9, 10, 11), (1.0, 1.0, 1.0)), mass="lumped"), jnp.array([0.01])
    assert np.isfinite(work(None, pencil, times))
    monkeypatch.setattr("hks_jax.spectrum_free.plan._MEMORY", 1e6)
    with monkeypatch.context() as patched:
        patched.delattr("hks_jax.spectrum_free.plan.dissect")
        assert work(None, pencil, times) == np.inf
        assert choose_method(pencil, times, "auto", 1e-3).degree > 1
    with pytest.raises(ValueError, match="traced"):
        jax.jit(lambda t: hj.hks_spectrum_free(pencil, t))(times)
    with pytest.raises(ValueError, match=r"a mesh with 1600 free vertices, .* more than 0\.001 GB\. Use eigenpairs"):
        hj.hks_spectrum_free(hj.examples.bumpy_torus_mesh(40), times)


def test_errors_say_what_to_do():
    field = flat((70, 70), (1.0, 1.0))
    with pytest.raises(ValueError, match=r"eigenpairs, smaller times"):
        hj.hks_spectrum_free(field, [0.5], mass="lumped", method="colouring")
    with pytest.raises(ValueError, match="positive finite times"):
        hj.hks_spectrum_free(field, [0.0])
    with pytest.raises(ValueError, match="tolerance: got 2"):
        hj.hks_spectrum_free(field, [0.1], method="colouring", tolerance=2)
    with unchecked(), pytest.raises(ValueError, match="method: got 'magic'"):
        hj.hks_spectrum_free(field, [0.1], method="magic")
    mesh = hj.examples.bumpy_torus_mesh(8)
    for call in (hj.colouring, partial(hj.hks_spectrum_free, method="colouring")):
        with unchecked(), pytest.raises(TypeError, match=r"got a mesh; expected a grid, .*selected-inversion"):
            call(mesh, [0.1])
    with unchecked(), pytest.raises(TypeError, match="domain: got int"):
        hj.hks_spectrum_free(3, [0.1])
