"""Curvature and expansion in three dimensions against closed forms, an exact heat kernel and finite elements."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference_warped import warped_hks

import hks_jax as hj
from hks_jax.domain import examples

GRID = hj.Grid.from_bounds(-0.2, 0.3, (8, 9, 10))


def nodal(field: hj.TensorField) -> hj.TensorField:
    """The same field without its function."""
    return hj.TensorField(field.grid, field.tensors)


def conformal(sign):
    """The 3-sphere or hyperbolic 3-space in the chart of a ball."""
    return lambda x: 4 / (1 + sign * x @ x) ** 2 * jnp.eye(3)


def sphere_times_line(x):
    factor = 4 / (1 + x[:2] @ x[:2]) ** 2
    return jnp.diag(jnp.stack([factor, factor, jnp.ones_like(factor)]))


def curvilinear(x):
    """A chart of flat space that bends all coordinate lines."""
    return jnp.stack([x[0] + 0.3 * x[1] ** 2, x[1] + 0.2 * jnp.sin(x[2]) + 0.2 * x[0], x[2] + 0.3 * x[0] * x[1]])


# metric, R, u₂ (McKean and Singer; for the first two exp(±t) is the diagonal of the whole kernel, times (4πt)^(-3/2))
SPACES = {
    "sphere": (conformal(1), 6, 1 / 2),
    "hyperbolic": (conformal(-1), -6, 1 / 2),
    "sphere × line": (sphere_times_line, 2, 1 / 15),
    "flat": (examples.pullback(curvilinear), 0, 0),
}


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=() if n == "sphere × line" else pytest.mark.slow) for n in SPACES]
)
def test_spaces_of_known_curvature(name):
    metric, R, u2 = SPACES[name]
    field, t = hj.TensorField.from_function(metric, GRID), 0.3
    np.testing.assert_allclose(hj.scalar_curvature(field), R, atol=1e-12)
    np.testing.assert_allclose(hj.scalar_curvature(nodal(field)), R, atol=0.6)
    np.testing.assert_allclose(hj.scalar_curvature(nodal(field))[3:-3, 3:-3, 3:-3], R, atol=1e-3)
    if name == "hyperbolic":  # one is enough for what all share, and takes seconds to compile
        expected = (1 + R / 6 * t + u2 * t**2) / (4 * np.pi * t) ** 1.5
        np.testing.assert_allclose(hj.hks_expansion(field, [t]), np.full((1, *GRID.shape), expected), rtol=1e-11)


def test_radius_scales_curvature():
    field = hj.TensorField.from_function(lambda x: 2.5**2 * conformal(1)(x), GRID)
    np.testing.assert_allclose(hj.scalar_curvature(field), 6 / 2.5**2, atol=1e-12)


@pytest.mark.slow
def test_on_a_surface_it_is_twice_the_gaussian_curvature():
    field = examples.bumpy_torus_field(9)
    np.testing.assert_allclose(hj.scalar_curvature(field), 2 * hj.gaussian_curvature(field), rtol=1e-12)


# ---------------------------------------------------------------------------------------------------- a warped torus


def a(v):
    return 0.8 + 0.2 * jnp.cos(v)


def b(v):
    return 0.8 + 0.15 * jnp.sin(2 * v)


def warped(x):
    return jnp.diag(jnp.stack([a(x[2]) ** 2, b(x[2]) ** 2, jnp.ones_like(x[2])]))


SKEW = jnp.array([[1.0, 0.4, 0.0], [-0.3, 1.0, 0.2], [1.0, 0.0, 1.0]])


def skewed_metric(y):
    """The same in coordinates y, x = SKEW y: every component and every derivative counts, and v = y₁ + y₃."""
    return SKEW.T @ warped(SKEW @ y) @ SKEW


def warped_curvature(v):
    """R = −2 (a''/a + b''/b + a'b'/(ab)), the sum of the sectional curvatures twice."""
    da, db = jax.grad(a), jax.grad(b)
    return -2 * (jax.grad(da)(v) / a(v) + jax.grad(db)(v) / b(v) + da(v) * db(v) / (a(v) * b(v)))


def torus_grid(shape):
    return hj.Grid(shape, [2 * np.pi / n for n in shape])


EXACT_TIMES, EXACT_NODES = np.array([0.02, 0.04]), 81


@pytest.fixture(scope="module")
def exact():
    return warped_hks(EXACT_TIMES, a, b, EXACT_NODES, 40)[1]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the scalar curvature is not resolved")  # of 16 nodes near sides
@pytest.mark.parametrize("periodic", [True, False])
def test_nodal_curvature_converges_at_high_order(periodic):
    errors = []
    for n in (16, 32):
        field = nodal(hj.TensorField.from_function(skewed_metric, torus_grid((n, n, n))))
        v = field.grid.nodes[..., 0] + field.grid.nodes[..., 2]
        expected = jnp.vectorize(warped_curvature)(v)
        errors.append(np.abs(hj.scalar_curvature(field, periodic) - expected).max())
    assert np.log2(errors[0] / errors[1]) > (4.8 if periodic else 2.3)


@pytest.mark.parametrize(
    ("source", "order"),
    [
        pytest.param("function", 2, marks=pytest.mark.slow),
        pytest.param("nodal", 1, marks=pytest.mark.slow),
        pytest.param("nodal", 2, marks=pytest.mark.slow),
    ],
)
def test_expansion_against_the_exact_kernel(order, source, exact):
    """R and Ric vary, and Ric has three different eigenvalues: every term of u₂ counts."""
    times, n = EXACT_TIMES, EXACT_NODES
    if source == "nodal":
        field, line = nodal(hj.TensorField.from_function(warped, torus_grid((8, 8, n)))), np.s_[:, 0, 0, :]
    else:
        field, line = hj.TensorField.from_function(skewed_metric, torus_grid((n, 2, 3))), np.s_[:, :, 0, 0]
    got = hj.hks_expansion(field, times, order, periodic=True)[line]
    errors = np.abs((4 * np.pi * times[:, None]) ** 1.5 * (got - exact)).max(axis=1)
    assert np.log2(errors[1] / errors[0]) == pytest.approx(order + 1, abs=0.15)


@pytest.mark.slow
def test_mask_leaves_nan_where_no_stencil_fits_and_nothing_else_changes():
    grid = hj.Grid.from_bounds(-0.5, 0.5, (16, 16, 16))
    tensors = np.array(hj.TensorField.from_function(conformal(1), grid).tensors)
    mask = np.ones(grid.shape, dtype=bool)
    mask[:6, :5, :7] = False
    tensors[~mask] = np.nan
    masked = hj.TensorField(hj.Grid(grid.shape, grid.spacing, grid.origin, mask), tensors)
    got = np.asarray(hj.scalar_curvature(masked))
    assert np.isnan(got[~mask]).all()
    np.testing.assert_allclose(got[mask], 6, atol=0.6)
    np.testing.assert_allclose(got[9:13, 8:13, 3:13], 6, atol=1e-3)  # all rows are centred


@pytest.mark.filterwarnings("ignore:the scalar curvature is not resolved")
def test_curvature_is_differentiable():
    grid = hj.Grid.from_bounds(-0.4, 0.4, (8, 8, 8))
    tensors = hj.TensorField.from_function(conformal(1), grid).tensors
    # R(c·g) = R(g)/c, so the derivative along g itself is −R.
    R, slope = jax.jvp(lambda T: hj.scalar_curvature(hj.TensorField(grid, T)), (tensors,), (tensors,))
    np.testing.assert_allclose(slope, -R, rtol=1e-9)


def test_orders_that_are_not_known_are_refused():
    with pytest.raises(ValueError, match=r"order: got 3; expected 0, 1 or 2, .* 3 dimensions"):
        hj.hks_expansion(hj.TensorField(GRID, np.broadcast_to(np.eye(3), (*GRID.shape, 3, 3))), [0.1], 3)


# ---------------------------------------------------------------------------------------------------- finite elements


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::hks_jax.AccuracyWarning")  # the grids' bias is what extrapolation removes
def test_finite_elements_agree_away_from_the_boundary():
    def lumpy(x):
        return jnp.exp(0.3 * jnp.sin(2 * x[0] + x[1])) * conformal(1)(x)

    times, at_centre, sizes = np.array([0.2, 0.25]), [], (9, 11)
    for n in sizes:
        field = hj.TensorField.from_function(lumpy, hj.Grid.from_bounds(-0.9, 0.9, (n, n, n)))
        at_centre.append(np.asarray(hj.hks(hj.eigenpairs(field, 110), times, "flat"))[:, n // 2, n // 2, n // 2])
    ratio = ((sizes[1] - 1) / (sizes[0] - 1)) ** 2
    signature = (ratio * at_centre[1] - at_centre[0]) / (ratio - 1)
    centre = hj.TensorField.from_function(lumpy, hj.Grid((2, 2, 2)))  # its first node
    first = 1 + times * float(hj.scalar_curvature(centre)[0, 0, 0]) / 6
    second = (4 * np.pi * times) ** 1.5 * hj.hks_expansion(centre, times)[:, 0, 0, 0]
    assert np.abs(signature - 1).max() > 0.2
    assert 0.02 < np.abs(signature - first).max() < 0.04
    assert np.abs(signature - second).max() < 0.007
