"""Derivatives of residuals that are computed in single precision."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hks_jax as hj
from hks_jax.eigen.adjoints.factorised_adjoint import FactorisedAdjoint
from hks_jax.inverse import Data
from hks_jax.inverse.observation import observe
from hks_jax.inverse.problem import Problem
from hks_jax.inverse.unknowns import unknowns_for

GRID, TIMES, K = hj.Grid((20, 18), 1 / 19), np.geomspace(0.02, 2.0, 4), 28
X, Y = GRID.nodes[..., 0], GRID.nodes[..., 1]
FIELD = hj.TensorField(GRID, np.exp(0.4 * np.sin(2 * X) * np.cos(3 * Y))[..., None, None] * np.eye(2))


def residuals_with(tolerance, boundary="neumann", signature="hks"):
    """The residuals of a fit as a function of its unknowns, unknowns where to look at it, and the problem."""
    space = hj.assemble(FIELD, boundary).space
    pairs = hj.eigenpairs(FIELD, K, boundary)
    target = 2 * hj.hks(pairs, TIMES)
    target = np.where(np.isfinite(target) & (target > 0), target, 1.0)
    if signature == "eigenvalues":
        target = pairs.eigenvalues
    observed, _ = observe(target, TIMES, Data(signature, "log" if signature == "hks" else "absolute"), space, float)
    unknowns = unknowns_for("log-euclidean", FIELD, space)
    solver = hj.BlockLanczos(adjoint=FactorisedAdjoint(tolerance))
    problem = Problem(unknowns, observed, (), K, boundary, solver)
    return lambda values: problem.residuals(values)[0], unknowns.start(), problem


@pytest.mark.slow
def test_they_are_those_in_double_precision_as_far_as_single_goes(rng):
    (residuals, values, _), (exact, *_) = residuals_with(1e-5), residuals_with(1e-10)
    direction = jnp.asarray(np.stack([np.sin(3 * X), np.cos(2 * Y), X * Y], axis=-1).reshape(values.shape))
    weights = jnp.asarray(rng.standard_normal(exact(values).shape))
    (r, product), (s, exactly) = jax.linearize(residuals, values), jax.linearize(exact, values)
    np.testing.assert_array_equal(r, s)
    change, expected = product(direction), exactly(direction)
    assert change.dtype == jnp.float64
    assert 0 < jnp.linalg.norm(change - expected) < 1e-5 * jnp.linalg.norm(expected)
    (gradient,), (wanted,) = (jax.linear_transpose(f, values)(weights) for f in (product, exactly))
    assert 0 < jnp.linalg.norm(gradient - wanted) < 1e-4 * jnp.linalg.norm(wanted)
    assert abs(jnp.vdot(gradient, direction) - jnp.vdot(weights, change)) < 1e-5 * jnp.linalg.norm(weights)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("tolerance", "boundary", "signature", "single"),
    [
        (1e-5, "neumann", "hks", True),
        (1e-8, "neumann", "hks", False),
        (1e-5, "neumann", "eigenvalues", False),
        (1e-5, "dirichlet", "hks", False),
    ],
)
def test_signatures_that_may_vanish_and_exact_solvers_keep_double_precision(tolerance, boundary, signature, single):
    residuals, values, problem = residuals_with(tolerance, boundary, signature)
    program = jax.make_jaxpr(lambda v: jax.jvp(residuals, (v,), (v + 1,))[1])(values)
    k = jax.eval_shape(problem.pairs, values).k
    assert (f"f32[{k}]" in str(program)) == single  # the eigenvalues, rounded
