"""The linear systems of Gauss–Newton steps: conjugate gradients and their preconditioners."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
import scipy.linalg
from fields import random_spd

import hks_jax as hj
from hks_jax.inverse.conformal import conformal_information
from hks_jax.inverse.gauss_newton import GaussNewton
from hks_jax.inverse.search import choose_inner_product
from hks_jax.inverse.unknowns import unknowns_for
from hks_jax.linear import conjugate_gradients


def ill_conditioned(rng, n):
    """Return a matrix with eigenvalues from 1 to 1e-8, and a preconditioner that helps little."""
    vectors = np.linalg.qr(rng.standard_normal((n, n)))[0]
    matrix = vectors * np.logspace(0, -8, n) @ vectors.T
    return jnp.asarray(matrix), jnp.asarray(rng.uniform(0.5, 2, n))


def solve(matrix, scale, rhs, tolerance, most=1000):
    """Solve with a diagonal preconditioner."""

    column = rhs[:, None]

    def product(x, first):
        return jnp.where(first, column, matrix @ x), 0

    def precondition(r):
        return jnp.reshape(scale, (-1, 1)) * r

    @jax.jit
    def solution():
        settings = {"most": jnp.asarray(most), "orthogonal": True}
        return conjugate_gradients.conjugate_gradients(
            product, precondition, jnp.zeros_like(column), jnp.full(1, tolerance), **settings
        )

    found = solution()
    np.testing.assert_array_equal(found.rhs[:, 0], rhs)
    return found.x[:, 0], found.steps


def test_rounding_costs_no_steps(rng):
    n = 60
    matrix, scale = ill_conditioned(rng, n)
    rhs = matrix @ rng.standard_normal(n)
    x, steps = solve(matrix, scale, rhs, 1e-7)
    residual = rhs - matrix @ x
    assert jnp.vdot(residual, scale * residual) <= 1.1e-14 * jnp.vdot(rhs, scale * rhs)
    assert steps <= n  # as in exact arithmetic


def test_only_so_many_residuals_are_kept(rng, monkeypatch):
    matrix, scale = ill_conditioned(rng, 40)
    matrix, rhs = matrix + 1e-3 * jnp.eye(40), jnp.asarray(rng.standard_normal(40))

    exact = np.linalg.solve(matrix, rhs)
    monkeypatch.setattr(conjugate_gradients, "_KEPT", 7)
    np.testing.assert_allclose(solve(matrix, scale, rhs, 1e-9)[0], exact, rtol=1e-6, atol=1e-6 * np.abs(exact).max())
    x, steps = solve(matrix, scale, rhs, 1e-9, 3)
    assert steps == 3
    assert jnp.isfinite(x).all()


def test_nothing_and_nan_are_told_apart():
    x, steps = solve(jnp.eye(5), 1, jnp.zeros(5), 1e-3)
    assert steps == 0
    assert not x.any()
    x, _ = solve(jnp.eye(5), 1, jnp.full(5, jnp.nan), 1e-3)
    assert jnp.isnan(x).all()


@pytest.mark.parametrize(("changes", "tight", "done"), [
    ((50, 10), False, False),  # the next one may be 2
    ((50, 6), True, False),
    ((50, 6, 0.9), True, True),
    ((50, 10, 0.9), True, False),  # solved as those before
    ((0.5,), True, False),
])  # fmt: skip
def test_only_a_step_with_a_tight_linear_system_may_be_the_last(changes, tight, done):
    """Steps are in tolerances; as soon as the next is expected to be below one, its system is solved to more digits."""
    optimiser, y = GaussNewton(1e-3), jnp.zeros(4)
    state = optimiser.init(lambda y, _: (y, None), y, None, {}, None, None, frozenset())
    state = optimiser.accepted(y, state)
    for change in changes:
        scale = 1e-3 * change / (1 - 1e-3 * change)  # a step s from 0 is s / (1 + s), relative to what it leads to
        state = eqx.tree_at(lambda s: (s.trial, s.gradient), state, (y + scale, -jnp.ones(4)))
        state = optimiser.accepted(y, state)
    np.testing.assert_allclose(state.change, changes[-1], rtol=1e-6)
    assert (bool(state.tight), bool(state.done)) == (tight, done)


@pytest.mark.parametrize("start", [2.0, pytest.param(1.0, marks=pytest.mark.slow)])
def test_an_exact_solution_is_an_end(start):
    """In float32 the root of x² − 4 has no residual, so that the gradient is zero and no step is left."""
    solution = optx.least_squares(lambda x, _: x**2 - 4, GaussNewton(), jnp.full(1, start, jnp.float32), max_steps=20)
    assert solution.value == 2


@pytest.mark.slow
def test_no_step_is_chosen_where_what_was_taken_will_do():
    def residuals(y, args):
        return y - 2, jnp.sum((y - 2) ** 2)

    optimiser, y, none = GaussNewton(), jnp.zeros(3), frozenset()
    structures = eqx.filter_eval_shape(residuals, y, None)
    begun = optimiser.init(residuals, y, None, {}, *structures, none)
    for sufficient, trial in ((11.0, 2), (12.0, 0)):
        options = {"enough": lambda told, level=sufficient: told <= level}
        taken, state, told = optimiser.step(residuals, y, None, options, begun, none)
        np.testing.assert_allclose((taken, state.trial), (jnp.zeros(3), jnp.full(3, trial)), rtol=1e-3)
        assert told == 12
        assert state.gradient[0] == -2  # known in any case


def preconditioner(field, times):
    """Return the unknowns, the inner product and the inverse of the preconditioner as a function of damping."""
    space = hj.assemble(field).space
    unknowns = unknowns_for("conformal", field, space)
    mass = choose_inner_product(unknowns, 0.0, None)
    information = conformal_information(unknowns, mass, jnp.asarray(times))
    eye = jnp.eye(unknowns.start().size)

    def inverse(damping):
        damping = jnp.asarray(damping)
        return np.asarray(jax.vmap(lambda x: information.precondition(x[:, None], damping)[:, 0])(eye))

    return unknowns, np.asarray(mass.apply(jnp.ones((len(eye), 1))))[:, 0], inverse


@pytest.mark.slow
def test_the_information_on_conformal_factors_is_that_of_a_power_of_the_laplacian():
    """The condition number of JᵀJ falls by much; damping bounds how far the preconditioner falls off."""
    grid = hj.Grid((12, 11), (1 / 11, 1 / 10))
    x, y = grid.nodes[..., 0], grid.nodes[..., 1]
    times = np.geomspace(0.02, 0.2, 3)
    flat = hj.TensorField(grid, np.broadcast_to(np.eye(2), (12, 11, 2, 2)))
    unknowns, mass, inverse = preconditioner(flat, times)

    def residuals(u):
        field = unknowns.field(u)
        return jnp.log(hj.hks(hj.eigenpairs(field, 132), times)).ravel()

    u = jnp.asarray((0.3 * np.sin(2 * x + y)).reshape(-1, 1))
    jacobian = np.asarray(jax.jacfwd(residuals)(u))[..., 0]
    information = jacobian.T @ jacobian
    p = inverse(1e-12)
    np.testing.assert_allclose(p, p.T, rtol=1e-10, atol=1e-12 * np.abs(p).max())
    before = scipy.linalg.eigh(information, np.diag(mass), eigvals_only=True)
    after = scipy.linalg.eigh(information, np.linalg.inv(p), eigvals_only=True)
    # The constant is another matter: it moves all times together.
    assert before[-1] / before[1] > 5 * after[-1] / after[1]
    for damping in (1e-4, 1e-3):
        values = scipy.linalg.eigh(inverse(damping), np.diag(1 / mass), eigvals_only=True)
        assert values[0] >= 1 - 1e-9
        assert values[-1] <= 0.03 / damping * (1 + 1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("d", [2, 3])
def test_the_preconditioner_is_definite_on_masks_and_for_any_metric(rng, d):
    shape = (6, 5, 4)[:d]
    mask = np.ones(shape, bool)
    mask[(0,) * d] = mask[(-1,) * d] = False
    field = hj.TensorField(hj.Grid(shape, 0.2, mask=mask), random_spd(rng, shape))
    _, mass, inverse = preconditioner(field, [0.05])
    p = inverse(1e-9)
    np.testing.assert_allclose(p, p.T, rtol=1e-10, atol=1e-12 * np.abs(p).max())
    assert scipy.linalg.eigh(p, np.diag(1 / mass), eigvals_only=True)[0] >= 1 - 1e-9
