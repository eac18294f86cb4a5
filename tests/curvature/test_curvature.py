"""Curvature and expansion against closed forms; the paper's slips, each with the check that shows it."""

from functools import partial
from math import factorial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference_torus import torus_hks

import hks_jax as hj
from hks_jax.curvature import taylor
from hks_jax.domain import examples

R, r = 2.0, 1.0


def nodal(field: hj.TensorField) -> hj.TensorField:
    """The same field without its function."""
    return hj.TensorField(field.grid, field.tensors)


def torus_curvature(v):
    return jnp.cos(v) / (r * (R + r * jnp.cos(v)))


def torus_laplacian(f, v):
    """∇²f of f(v) on the torus of revolution: (w f')'/(r² w)."""
    w = lambda v: R + r * jnp.cos(v)  # noqa: E731
    flux = lambda v: w(v) * jax.grad(f)(v)  # noqa: E731
    return jax.grad(flux)(v) / (r**2 * w(v))


def skewed(x):
    """A chart of the torus whose coordinate lines are neither orthogonal nor lines of curvature."""
    return jnp.stack([x[0] + 0.3 * jnp.sin(x[1]), x[1] + 0.2 * jnp.cos(x[0] + x[1])])


def skewed_torus(shape):
    position = partial(examples.torus, major=R, minor=r)
    grid = hj.Grid(shape, [2 * np.pi / n for n in shape])
    field = hj.TensorField.from_function(examples.pullback(lambda x: position(skewed(x))), grid)
    return field, jax.vmap(jax.vmap(skewed))(jnp.asarray(grid.nodes))[..., 1]


@pytest.mark.slow
def test_curvature_from_a_function_is_exact():
    np.testing.assert_allclose(hj.gaussian_curvature(examples.sphere_field(9)), 1, atol=1e-12)
    np.testing.assert_allclose(hj.gaussian_curvature(examples.hyperbolic_field(9)), -1, atol=1e-12)
    field = examples.torus_field((5, 12), R, r)
    v = field.grid.nodes[..., 1]
    np.testing.assert_allclose(hj.gaussian_curvature(field), torus_curvature(v), atol=1e-13)
    field, v = skewed_torus((6, 7))
    assert np.abs(field.tensors[..., 0, 1]).max() > 0.5
    np.testing.assert_allclose(hj.gaussian_curvature(field), torus_curvature(v), atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("periodic", [True, False])
def test_nodal_curvature_converges_at_high_order(periodic):
    errors = []
    for n in (40, 80):
        field, v = skewed_torus((n, n))
        error = hj.gaussian_curvature(nodal(field), periodic=periodic) - torus_curvature(v)
        errors.append(np.abs(error).max())
    assert np.log2(errors[0] / errors[1]) > (4.8 if periodic else 2.6)  # sixth order inside, third order at sides
    assert errors[1] < (1e-3 if periodic else 0.05)


@pytest.mark.slow
def test_laplace_beltrami_of_known_functions():
    # A coordinate function of the unit sphere: ∇²f = −2f. Stereographic: z = (1 − |x|²)/(1 + |x|²).
    field = examples.sphere_field(41, 1.0)

    def height(x):
        return (1 - x @ x) / (1 + x @ x)

    values = jax.vmap(jax.vmap(height))(jnp.asarray(field.grid.nodes))
    np.testing.assert_allclose(hj.laplace_beltrami(field, height), -2 * values, atol=1e-12)
    got = hj.laplace_beltrami(nodal(field), values)
    np.testing.assert_allclose(got, -2 * values, atol=0.02)
    np.testing.assert_allclose(got[3:-3, 3:-3], -2 * values[3:-3, 3:-3], atol=2e-6)
    # The 3-sphere: ∇²f = −3f.
    grid = hj.Grid.from_bounds(-0.5, 0.5, (12, 12, 12))
    ball = hj.TensorField.from_function(lambda x: 4 / (1 + x @ x) ** 2 * jnp.eye(3), grid)
    values = jax.vmap(jax.vmap(jax.vmap(height)))(jnp.asarray(grid.nodes))
    np.testing.assert_allclose(hj.laplace_beltrami(ball, height), -3 * values, atol=1e-12)
    np.testing.assert_allclose(hj.laplace_beltrami(nodal(ball), values), -3 * values, atol=0.25)
    field, v = skewed_torus((48, 48))
    expected = jax.vmap(jax.vmap(partial(torus_laplacian, torus_curvature)))(v)
    np.testing.assert_allclose(hj.laplace_beltrami(field, torus_curvature(v), periodic=True), expected, atol=5e-3)


def test_mask_leaves_nan_where_no_stencil_fits_and_nothing_else_changes():
    field = nodal(examples.sphere_field(31, 1.0))
    mask = np.ones((31, 31), dtype=bool)
    mask[:12, :9] = False
    tensors = np.where(mask[..., None, None], field.tensors, np.nan)
    got = hj.gaussian_curvature(hj.TensorField(hj.Grid((31, 31), field.grid.spacing, field.grid.origin, mask), tensors))
    assert np.isnan(got[~mask]).all()
    np.testing.assert_allclose(got[mask], 1, atol=0.2)
    np.testing.assert_allclose(got[15:-3, 3:-3], 1, atol=1e-4)  # no row reaches over a side or the rim
    narrow = np.zeros((31, 31), dtype=bool)
    narrow[10:15] = narrow[:, 10:20] = True  # the arms are five nodes wide: too narrow for a stencil across
    masked = hj.TensorField(hj.Grid((31, 31), field.grid.spacing, field.grid.origin, narrow), field.tensors)
    got = np.asarray(hj.gaussian_curvature(masked))
    assert np.isnan(got[12, 2])
    assert got[2, 14] == pytest.approx(1, abs=0.2)


def noisy(grid, level, seed=0):
    """Flat tensors with independent noise of a relative level."""
    white = np.random.default_rng(seed).normal(size=(*grid.shape, 2, 2))
    return hj.TensorField(grid, np.eye(2) + level * (white + np.swapaxes(white, -1, -2)) / 2)


@pytest.mark.slow
def test_noise_at_sides_corners_and_rims_is_like_that_inside():
    mask = np.ones((40, 40), bool)
    mask[:15, :15] = False
    for shown in (None, mask):
        grid = hj.Grid((40, 40), mask=shown)
        draws = jnp.stack([noisy(grid, 1e-3, seed).tensors for seed in range(100)])
        found = jax.vmap(lambda T, grid=grid: hj.gaussian_curvature(hj.TensorField(grid, T)))(draws)
        K = np.sqrt(np.mean(np.square(found), axis=0)) / 1e-3
        inside = K[22:34, 22:34].mean()
        assert inside == pytest.approx(2.58, rel=0.05)
        assert np.nanmax(K) < 3 * inside
        assert K[-1, 20:35].mean() < 2 * inside
        assert K[-4, 20:35].mean() < 1.2 * inside


@pytest.mark.slow
def test_curvature_that_is_noise_is_told():
    with pytest.warns(
        hj.AccuracyWarning, match=r"Gaussian curvature has an error of about 0\.0[89].* 0\.05.*smooth_tensors"
    ):
        hj.gaussian_curvature(noisy(hj.Grid((40, 40)), 0.05))
    with pytest.warns(hj.AccuracyWarning, match="coefficient u1 .* by noise"):
        hj.hks_expansion(noisy(hj.Grid((40, 40)), 0.05), [4.0], 1)
    hj.gaussian_curvature(noisy(hj.Grid((40, 40)), 1e-6))  # less than 1/area
    jax.jit(hj.gaussian_curvature)(noisy(hj.Grid((40, 40)), 0.05))


@pytest.mark.slow
def test_error_bars_of_curvature_contain_the_truth():
    grid = hj.Grid((30, 30), 0.05)
    x, y = np.moveaxis(grid.nodes, -1, 0)
    exact = np.exp(0.4 * np.sin(3 * x) * np.cos(2 * y))[..., None, None] * np.eye(2)
    noise = hj.TensorNoise.relative(exact, 0.01, grid)

    def curvature(tensors):
        return hj.gaussian_curvature(hj.TensorField(grid, hj.smooth_tensors(grid, tensors, 0.1)))[None]

    measured = exact + noise.tensors(jax.random.normal(jax.random.key(0), noise.white_shape))
    bars = hj.uncertainty(curvature, measured, noise, draws=32)
    z = np.abs(curvature(measured) - curvature(exact)) / bars.deviation
    assert np.mean(z < 1) == pytest.approx(0.68, abs=0.08)
    assert np.mean(z < 2) == pytest.approx(0.95, abs=0.04)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [pytest.param(jnp.float32, marks=pytest.mark.slow), jnp.float64])
def test_no_smooth_field_is_called_noise(dtype):
    fields = [
        examples.sphere_field(40, 1.0),
        examples.torus_field((40, 40), R, r),
        examples.hyperbolic_field(40),
        *examples.figure4_fields(40).values(),
    ]
    for field in fields:
        hj.gaussian_curvature(hj.TensorField(field.grid, field.tensors.astype(dtype)))


def test_a_grid_that_does_not_resolve_the_metric_is_told():
    """On the chart (−3, 3)² of the unit sphere, nodal K is −101 … 11 with 21 nodes per axis, and 0.9 … 1.1 with 121."""
    coarse = nodal(examples.sphere_field(21))
    with pytest.warns(
        hj.AccuracyWarning, match=r"Gaussian curvature is not resolved by the grid at [2-5]\d\.\d% of the"
    ):
        K = np.asarray(hj.gaussian_curvature(coarse))
    error = np.abs(K - 1)
    assert np.mean(error > 0.25) == pytest.approx(0.35, abs=0.05)  # what the message estimates


@pytest.mark.slow
def test_only_a_grid_that_does_not_resolve_the_metric_is_told():
    coarse, fine = nodal(examples.sphere_field(21)), nodal(examples.sphere_field(121))
    with pytest.warns(hj.AccuracyWarning, match="coefficient u1 of the expansion is not resolved"):
        hj.hks_expansion(coarse, [1.0], 1)
    with pytest.warns(hj.AccuracyWarning, match="Gaussian curvature is not resolved"):
        jax.grad(lambda T: hj.gaussian_curvature(hj.TensorField(coarse.grid, T)).sum())(coarse.tensors)
    np.testing.assert_allclose(hj.gaussian_curvature(fine), 1, atol=0.1)
    hj.gaussian_curvature(nodal(examples.torus_field((12, 24), R, r)), periodic=True)
    hj.gaussian_curvature(hj.TensorField(hj.Grid((9, 9)), np.broadcast_to(np.diag([1.0, 4.0]), (9, 9, 2, 2))))  # flat


@pytest.mark.slow
def test_rounding_of_the_third_coefficient_is_told():
    """Sixth derivatives amplify rounding by 1/h⁶: on a fine grid u₃ = 4/315 is lost, on a coarse one it is exact."""
    coarse, fine = (examples.sphere_field(30, width) for width in (1.0, 0.015))
    with pytest.warns(hj.AccuracyWarning, match=r"coefficient u3 .* by rounding .* float64.*every second node"):
        hj.hks_expansion(nodal(fine), [1.0])
    got = hj.hks_expansion(nodal(coarse), [1.0])[0]
    np.testing.assert_allclose(got[6:-6, 6:-6], (1 + 1 / 3 + 1 / 15 + 4 / 315) / (4 * np.pi), rtol=1e-3)
    assert np.isnan(got[:6]).all()


@pytest.mark.slow
def test_curvature_is_differentiable_and_traceable():
    field = nodal(examples.sphere_field(10, 0.3))

    def mean(T):
        return jnp.mean(hj.gaussian_curvature(hj.TensorField(field.grid, T)))

    # K(c·g) = K(g)/c, so the derivative along g itself is −K.
    slope = jax.jit(jax.grad(mean))(field.tensors)
    assert jnp.sum(slope * field.tensors) == pytest.approx(-float(mean(field.tensors)), rel=1e-10)
    both = jax.vmap(mean)(jnp.stack([field.tensors, 2 * field.tensors]))
    assert both[0] == pytest.approx(2 * float(both[1]))


@pytest.mark.slow
def test_sphere_expansion_has_the_textbook_coefficients():
    # 4πt·k = 1 + t/3 + t²/15 + 4t³/315 + …
    t = np.array([0.1, 0.3])
    expected = 1 + t / 3 + t**2 / 15 + 4 * t**3 / 315
    got = hj.hks_expansion(examples.sphere_field(5), t)
    np.testing.assert_allclose(got, np.broadcast_to((expected / (4 * np.pi * t))[:, None, None], got.shape), rtol=1e-9)


def expansion_errors(coefficients) -> np.ndarray:
    """Observed orders in t of (exact heat kernel − expansion) on the torus of revolution, relative to 1/4πt."""
    times = np.array([0.025, 0.05])
    v, exact = torus_hks(times, R, r, 101)
    series = sum(np.asarray(u)[None] * times[:, None] ** i for i, u in enumerate(coefficients(v)))
    errors = np.abs(4 * np.pi * times[:, None] * exact - series).max(axis=1)
    return np.log2(errors[1] / errors[0])


_REST = [*((order, "nodal") for order in range(4)), *((order, "function") for order in (0, 2, 3))]
SLOW = [pytest.param(*case, marks=pytest.mark.slow) for case in _REST]


@pytest.mark.parametrize(("order", "source"), [(1, "function"), *SLOW])
def test_expansion_against_the_exact_kernel_of_a_torus(order, source):
    """K varies, so that all terms of u₂ and u₃ count."""
    times = np.array([0.05, 0.1])
    n = 81
    field = examples.torus_field((8, n), R, r)
    got = hj.hks_expansion(field if source == "function" else nodal(field), times, order, periodic=True)
    _, exact = torus_hks(times, R, r, n)
    errors = np.abs(4 * np.pi * times * (got[:, 0] - exact).T).max(axis=0)
    assert np.log2(errors[1] / errors[0]) == pytest.approx(order + 1, abs=0.15)


@pytest.mark.slow
def test_expansion_does_not_depend_on_the_chart():
    """Off-diagonal components in every term, u₃ with its six derivatives included, against the orthogonal chart."""

    def chart(y):
        return jnp.stack([y[0] + 0.2 * y[1] ** 2, y[1] + 0.3 * y[0] + 0.1 * y[0] * y[1]])

    def metric(y):
        J, w = jax.jacfwd(chart)(y), R + r * jnp.cos(chart(y)[1])
        return J.T @ jnp.diag(jnp.stack([w**2, jnp.full_like(w, r**2)])) @ J

    grid = hj.Grid.from_bounds(-0.5, 1.0, (4, 5))
    skew = hj.TensorField.from_function(metric, grid)
    assert np.abs(skew.tensors[..., 0, 1]).max() > 0.5
    v = jax.vmap(jax.vmap(chart))(jnp.asarray(grid.nodes))[..., 1].ravel()
    of_torus = partial(torus_laplacian, torus_curvature)
    K, slope = torus_curvature(v), jax.vmap(jax.grad(torus_curvature))(v) / r
    first, second = jax.vmap(of_torus)(v), jax.vmap(partial(torus_laplacian, of_torus))(v)
    t = 0.7
    u2, u3 = (K**2 + first) / 15, 4 * K**3 / 315 + 2 * slope**2 / 105 + K * first / 30 + second / 140
    expected = (1 + K / 3 * t + u2 * t**2 + u3 * t**3) / (4 * np.pi * t)
    np.testing.assert_allclose(hj.hks_expansion(skew, [t])[0].ravel(), expected, rtol=1e-10)


def test_taylor_series_and_their_arithmetic():
    # exp(x + 2y) at the origin has the coefficients 2ʲ/(i! j!); its reciprocal has those of exp(−x − 2y).
    series = taylor.expand(lambda x: jnp.exp(x[0] + 2 * x[1]), jnp.zeros(2), 4)
    powers = [(k - j, j) for k in range(5) for j in range(k + 1)]
    np.testing.assert_allclose(series, [2**j / (factorial(i) * factorial(j)) for i, j in powers], atol=1e-14)
    signs = np.array([(-1) ** (i + j) for i, j in powers])
    np.testing.assert_allclose(taylor.reciprocal(series), signs * np.asarray(series), atol=1e-13)
    np.testing.assert_allclose(taylor.derivative(series, 1), 2 * series[:10], atol=1e-13)
    one = taylor.product(series, taylor.reciprocal(series))
    np.testing.assert_allclose(one, np.eye(15)[0], atol=1e-13)


@pytest.mark.slow
def test_nodal_expansion_in_float32_is_sound_up_to_30_h_squared():
    field = examples.torus_field((32, 32), R, r)
    single = hj.TensorField(field.grid, field.tensors.astype(jnp.float32))
    t = 30 * (2 * np.pi / 32) ** 2  # h² is least across the tube, where the spacing is 2π/32 in length
    got, expected = (
        hj.hks_expansion(f, jnp.array([t], f.tensors.dtype), periodic=True) for f in (single, nodal(field))
    )
    assert got.dtype == jnp.float32
    np.testing.assert_allclose(got, expected, rtol=5e-3)  # rounding, up to 2e-3 as XLA orders it


@pytest.mark.slow
def test_slip_u2_as_printed_leaves_an_error_of_order_two():
    def right(v):
        K = torus_curvature(v)
        return np.ones_like(v), K / 3, K**2 / 15 + jax.vmap(partial(torus_laplacian, torus_curvature))(v) / 15

    def printed(v):  # (4K² − 3ΔK)/45, with Δ = −∇²
        K = torus_curvature(v)
        return np.ones_like(v), K / 3, (4 * K**2 + 3 * jax.vmap(partial(torus_laplacian, torus_curvature))(v)) / 45

    assert expansion_errors(right) == pytest.approx(3, abs=0.1)
    assert expansion_errors(printed) == pytest.approx(2, abs=0.25)


def test_slip_curvature_of_a_diagonal_metric_needs_a_plus():
    """K = −1/(2√EG) (∂₁(∂₁G/√EG) ± ∂₂(∂₂E/√EG)): with plus it is 1 on the sphere, with minus it is not."""

    def curvature(sign, x):
        def root(x):
            return jnp.sqrt(E(x) * G(x))

        E = G = lambda x: 4 / (1 + x @ x) ** 2
        first = jax.grad(lambda x: jax.grad(G)(x)[0] / root(x))(x)[0]
        second = jax.grad(lambda x: jax.grad(E)(x)[1] / root(x))(x)[1]
        return -(first + sign * second) / (2 * root(x))

    x = jnp.array([0.4, 0.1])
    assert curvature(1, x) == pytest.approx(1)
    assert abs(curvature(-1, x) - 1) > 0.5


@pytest.mark.slow
def test_slip_varadhan_is_a_limit_of_small_times():
    """−4t log k_t(x, y) → d²(x, y) as t → 0; as t → ∞ it grows without bound, like 4t log(area)."""
    n = 33
    field = hj.TensorField(hj.Grid((n, n), 1 / (n - 1)), np.broadcast_to(np.diag([1.0, 4.0]), (n, n, 2, 2)))
    pairs = hj.eigenpairs(field, n * n)
    i, j = (8, 16), (24, 16)  # half the width apart along axis 0, far from the sides along axis 1
    times = np.array([0.04, 0.02, 0.01])
    estimate = -4 * times * np.log(hj.heat_kernel(pairs, times, i)[:, 0, *j] * 4 * np.pi * times)
    np.testing.assert_allclose(estimate, 0.25, rtol=0.06)
    raw = -4 * times * np.log(hj.heat_kernel(pairs, times, i)[:, 0, *j])
    assert (np.diff(np.abs(raw - 0.25)) < 0).all()
    late = -4 * 50.0 * np.log(hj.heat_kernel(pairs, [50.0], i)[0, 0, *j])
    assert late == pytest.approx(4 * 50 * np.log(2))  # the area is 2
    # The series of the expansion begins at i = 0 with u₀ = 1.
    inside = hj.hks(pairs, [0.01], "flat")[0, 16, 16]
    assert inside == pytest.approx(1, abs=0.02)


@pytest.mark.slow
def test_slip_laplacian_without_its_minus_goes_with_a_negative_mass():
    """div grad is negative: with Δf = div grad f the weak form is Kφ = −λMφ, and all λ ≤ 0; heat would grow."""
    n = 33
    field = hj.TensorField(hj.Grid((n, n), 1 / (n - 1)), np.broadcast_to(np.diag([1.0, 4.0]), (n, n, 2, 2)))
    f = jnp.cos(np.pi * field.grid.nodes[..., 0]) * jnp.cos(np.pi * field.grid.nodes[..., 1])
    eigenvalue = np.pi**2 * (1 + 1 / 4)
    inner = (slice(4, -4), slice(4, -4))
    np.testing.assert_allclose(hj.laplace_beltrami(field, f)[inner], -eigenvalue * f[inner], rtol=0.01, atol=0.01)
    pencil = hj.assemble(field)
    energy, norm = (float(f.ravel() @ (operator @ f.ravel())) for operator in (pencil.stiffness, pencil.mass))
    assert energy / norm == pytest.approx(eigenvalue, rel=2e-3)  # the paper's HKS has exp(−λt) with this λ
    assert energy / -norm == pytest.approx(-eigenvalue, rel=2e-3)  # what its M gives: exp(−λt) > 1


def test_bad_arguments():
    cube = hj.TensorField(hj.Grid((9, 9, 9)), np.broadcast_to(np.eye(3), (9, 9, 9, 3, 3)))
    flat = hj.TensorField(hj.Grid((9, 9)), np.broadcast_to(np.eye(2), (9, 9, 2, 2)))
    small = hj.TensorField(hj.Grid((5, 9)), np.broadcast_to(np.eye(2), (5, 9, 2, 2)))
    with pytest.raises(ValueError, match=r"field: got a grid of shape .* two dimensions"):
        hj.gaussian_curvature(cube)
    with pytest.raises(ValueError, match=r"grid: got shape \(5, 9\); expected at least \(7, 7\) nodes"):
        hj.gaussian_curvature(small)
    with pytest.raises(ValueError, match=r"order: got 4; expected 0, 1, 2 or 3, .* 2 dimensions"):
        hj.hks_expansion(flat, [0.1], 4)
    with pytest.raises(ValueError, match=r"times: got -0\.1; expected positive finite"):
        hj.hks_expansion(flat, [-0.1])
    with pytest.raises(ValueError, match="periodic"):
        hj.gaussian_curvature(flat, periodic=(True,) * 3)
