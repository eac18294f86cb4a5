"""Heat flow of functions, its derivatives, and the scale spaces that signatures are compared with."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from annotations import unchecked
from fields import random_spd
from scipy.linalg import expm

import hks_jax as hj

SHAPE = (6, 5)
TIMES = np.array([0.02, 0.3])


@pytest.fixture(scope="module")
def field():
    mask = np.ones(SHAPE, bool)
    mask[4:, 3:] = False
    return hj.TensorField(hj.Grid(SHAPE, (0.2, 0.3), mask=mask), random_spd(np.random.default_rng(1), SHAPE))


def exact(field, boundary, u):
    """exp(−tM⁻¹K)u at the free nodes."""
    pencil = hj.assemble(field, boundary)
    A = np.linalg.solve(pencil.mass.to_dense(), pencil.stiffness.to_dense())
    return np.stack([expm(-t * A) @ np.asarray(pencil.space.restrict(jnp.asarray(u))) for t in TIMES]), pencil.space


@pytest.mark.parametrize(
    ("boundary", "k"), [pytest.param("dirichlet", 11, marks=pytest.mark.slow), (("neumann", "mirror"), 42)]
)
def test_heat_flow_is_the_matrix_exponential(field, boundary, k, rng):
    u = np.where(field.grid.inside, rng.standard_normal(SHAPE), np.nan)
    plain = boundary if k == 11 else "neumann"  # a mirrored function flows as with natural sides
    expected, space = exact(field, plain, np.nan_to_num(u))
    pairs = hj.eigenpairs(field, k, boundary, solver="dense")
    assert k == sum(part.space.n_dof for part in pairs.pencil.parts)
    flow = np.asarray(hj.heat_flow(pairs, TIMES, u))
    np.testing.assert_allclose(flow[:, space.free], expected, atol=1e-10)
    np.testing.assert_array_equal(np.isnan(flow[0]), ~space.domain)
    assert (flow[:, space.domain & ~space.free] == 0).all()
    several = np.asarray(hj.heat_flow(pairs, TIMES, [[u, 2 * u]]))
    np.testing.assert_allclose(several, np.stack([flow, 2 * flow], axis=1)[:, None])


@pytest.mark.slow
def test_derivatives_of_a_truncated_flow(field, rng):
    weights = np.where(field.grid.inside, rng.standard_normal((2, *SHAPE)), 0)
    start = {"tensors": field.tensors, "times": jnp.asarray(TIMES), "u": jnp.asarray(rng.standard_normal(SHAPE))}
    direction = {
        "tensors": jnp.asarray(rng.standard_normal((*SHAPE, 2, 2))) * 0.1,
        "times": jnp.asarray([0.01, -0.1]),
        "u": jnp.asarray(rng.standard_normal(SHAPE)),
    }
    direction["tensors"] = direction["tensors"] + jnp.swapaxes(direction["tensors"], -1, -2)

    @jax.jit
    @jax.value_and_grad
    def loss(x):
        pairs = hj.eigenpairs(hj.TensorField(field.grid, x["tensors"]), 12, solver="dense")
        flow = hj.heat_flow(pairs, x["times"], x["u"])
        return jnp.sum(jnp.where(field.grid.inside, flow, 0) * weights)

    def moved(names, step):
        return {n: v + (step * direction[n] if n in names else 0) for n, v in start.items()}

    gradient = loss(start)[1]
    for name in start:
        h = 1e-4
        ends = [float(loss(moved([name], s * h))[0]) for s in (1, -1, 2, -2)]
        difference = (8 * (ends[0] - ends[1]) - (ends[2] - ends[3])) / (12 * h)
        assert float(jnp.sum(gradient[name] * direction[name])) == pytest.approx(difference, rel=1e-6)


def test_flow_errors_and_warnings(field):
    pairs = hj.eigenpairs(field, 4, "dirichlet", solver="dense")
    with pytest.raises(
        ValueError, match=r"functions: got shape \(5, 6\); expected \(6, 5\), with optional leading axes"
    ):
        hj.heat_flow(pairs, TIMES, np.ones((5, 6)))
    with pytest.raises(ValueError, match="functions: got 11 NaN or infinite values inside the mask"):
        hj.heat_flow(pairs, TIMES, np.full(SHAPE, np.nan))
    rough = np.indices(SHAPE).sum(axis=0) % 2.0
    with pytest.warns(hj.AccuracyWarning, match=r"times: at t = 0.02 up to [1-9]"):
        hj.heat_flow(pairs, TIMES, rough)
    hj.heat_flow(pairs, TIMES, pairs.eigenfunctions[1])  # nothing of it is missing


# --- scale spaces -------------------------------------------------------------------------------------------


def test_invariants():
    tensors = random_spd(np.random.default_rng(0), (3, 4))
    low, high = np.moveaxis(np.linalg.eigvalsh(tensors), -1, 0)
    found = hj.tensor_invariants(hj.TensorField(hj.Grid((3, 4)), tensors))
    np.testing.assert_allclose(found["trace"], low + high)
    np.testing.assert_allclose(found["determinant"], low * high)
    np.testing.assert_allclose(found["anisotropy"], (high - low) / (high + low))
    with unchecked(), pytest.raises(TypeError, match=r"got ndarray; expected hks_jax.TensorField.*Grid\(shape\), T"):
        hj.tensor_invariants(tensors)
    solid = hj.TensorField(hj.Grid((2, 2, 2)), np.broadcast_to(np.diag([1.7, 0.3, 0.2]), (2, 2, 2, 3, 3)))
    fa = np.sqrt(1.5 * (0.9667**2 + 0.4333**2 + 0.5333**2) / (1.7**2 + 0.3**2 + 0.2**2))
    np.testing.assert_allclose(hj.tensor_invariants(solid)["anisotropy"], fa, rtol=1e-3)


def test_on_a_flat_metric_gaussian_smoothing_is_the_heat_flow():
    """For cosines both are exp(−λt); the metric 4·I makes distances twice as long."""
    grid = hj.Grid.from_bounds(0, (1.0, 1.5), (41, 61))
    field = hj.TensorField(grid, np.broadcast_to(4 * np.eye(2), (41, 61, 2, 2)))
    x, y = np.moveaxis(grid.nodes, -1, 0)
    u = np.cos(np.pi * x) * np.cos(4 * np.pi * y / 1.5)
    blurred = hj.gaussian_scale_space(field, [0.02, 0.1], u)
    rate = np.pi**2 * (1 + (4 / 1.5) ** 2) / 4
    np.testing.assert_allclose(blurred, np.exp(-rate * np.array([0.02, 0.1]))[:, None, None] * u, atol=2e-3)


def test_smoothing_keeps_constants_and_masks():
    mask = np.hypot(*np.indices((20, 18)) - 9) < 8
    field = hj.TensorField(hj.Grid((20, 18), mask=mask), np.broadcast_to(np.eye(2), (20, 18, 2, 2)))
    u = np.where(mask, [np.full((20, 18), 3.0), np.indices((20, 18))[0]], np.nan)
    blurred = hj.gaussian_scale_space(field, [1.0, 1e9], u)
    assert blurred.shape == (2, 2, 20, 18)
    np.testing.assert_array_equal(np.isfinite(blurred), np.broadcast_to(mask, blurred.shape))
    np.testing.assert_allclose(blurred[:, 0, mask], 3)
    np.testing.assert_allclose(blurred[1, 1, mask], u[1][mask].mean(), rtol=1e-4)
    assert np.abs(blurred[0, 1, mask] - u[1][mask]).max() < 1
    with pytest.raises(ValueError, match=r"times: got shape \(0,\); expected a number or a non-empty 1-D array"):
        hj.gaussian_scale_space(field, [], u)
    with pytest.raises(ValueError, match=r"functions: got shape \(18, 20\)"):
        hj.gaussian_scale_space(field, [1.0], u[0].T)


def test_smoothing_and_invariants_name_traced_arguments_and_take_constants(field):
    u = np.where(field.grid.inside, 1.0, np.nan)

    def moved(tensors):
        return hj.TensorField(field.grid, tensors)

    for name, call, value in (
        ("times", lambda t: hj.gaussian_scale_space(field, t, u), jnp.asarray(TIMES)),
        ("functions", lambda f: hj.gaussian_scale_space(field, TIMES, f), jnp.asarray(u)),
        ("field", lambda T: hj.gaussian_scale_space(moved(T), TIMES, u), field.tensors),
        ("field", lambda T: hj.tensor_invariants(moved(T)), field.tensors),
    ):
        with unchecked(), pytest.raises(ValueError, match=f"{name}: got a traced value"):
            jax.jit(call)(value)
    both = jax.jit(lambda: (hj.gaussian_scale_space(field, TIMES, u), hj.tensor_invariants(field)["trace"]))()
    np.testing.assert_allclose(both[0], hj.gaussian_scale_space(field, TIMES, u))
    np.testing.assert_allclose(both[1], hj.tensor_invariants(field)["trace"])
