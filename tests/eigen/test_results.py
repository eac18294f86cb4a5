"""What did not converge is told: by a warning, by a code under jit, by an error where one is asked for."""

import re
import warnings
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fields import flat

import hks_jax as hj

FEW = hj.ChebyshevFilter(max_rounds=1)
GRID = hj.Grid((24, 22), 0.1)
TENSORS = jnp.broadcast_to(jnp.diag(jnp.asarray([1.0, 1.3])), (24, 22, 2, 2))


def solve(tensors, **settings):
    return hj.eigenpairs(hj.TensorField(GRID, tensors), 12, **settings)


@pytest.mark.parametrize(
    "solver", ["shift-invert", *(pytest.param(s, marks=pytest.mark.slow) for s in ("dense", "block-lanczos"))]
)
def test_success_is_a_code_that_is_traced(solver):
    results = jax.jit(jax.vmap(lambda T: solve(T, solver=solver).result))(jnp.stack([TENSORS, 2 * TENSORS]))
    assert (results == hj.RESULTS.successful).all()


def test_a_failure_is_a_code_under_jit_and_a_warning_otherwise():
    result = jax.jit(lambda T: solve(T, solver=FEW).result)(TENSORS)
    assert result == hj.RESULTS.unconverged
    with pytest.warns(hj.AccuracyWarning, match="did not converge"):
        pairs = solve(TENSORS, solver=FEW)
    assert pairs.result == hj.RESULTS.unconverged
    assert not pairs.converged.all()


def test_tensors_that_are_not_positive_definite_are_a_code_under_jit():
    broken = TENSORS.at[3, 4].multiply(-1)
    assert jax.jit(lambda T: solve(T, solver="dense").result)(broken) == hj.RESULTS.not_finite
    batch = jax.jit(jax.vmap(lambda T: solve(T, solver="dense").result))(jnp.stack([TENSORS, broken]))
    np.testing.assert_array_equal(batch == hj.RESULTS.successful, [True, False])


@pytest.mark.slow
def test_a_failure_is_an_error_if_asked_for():
    run = partial(solve, solver=FEW, throw=True)
    with pytest.raises(RuntimeError, match="did not converge"):
        run(TENSORS)
    with pytest.raises(RuntimeError, match="did not converge"):
        jax.block_until_ready(jax.jit(lambda T: run(T).eigenvalues)(TENSORS))
    np.testing.assert_array_equal(
        jax.jit(lambda T: solve(T, throw=True).eigenvalues)(TENSORS), jax.jit(lambda T: solve(T).eigenvalues)(TENSORS)
    )


def without_guards(solver):
    """Return a solver like this one that computes no pair more than asked for."""
    kind = type("WithoutGuards", (type(solver),), {"guards": lambda self, k, n_dof: 0})
    return kind(**vars(solver))


SOLVERS = [hj.BlockLanczos(), hj.ShiftInvert(), hj.ChebyshevFilter(block=8)]


@pytest.mark.slow
@pytest.mark.parametrize(
    "solver",
    [pytest.param(s, id=s.name) for s in SOLVERS],
)
def test_a_derivative_that_does_not_converge_is_told(solver):
    """The first four eigenvalues above zero of a flat torus are equal: a spectrum cut there has no derivative."""
    field, solver = flat((20, 20), (1.0, 1.0), (True, True)), without_guards(solver)

    def loss(tensors, throw=False):
        pairs = hj.eigenpairs(hj.TensorField(field.grid, tensors), 2, "periodic", solver, throw=throw)
        return jnp.sum(hj.hks(pairs, [0.1]) ** 2)

    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        gradient = jax.grad(loss)(field.tensors)
        assert jnp.isnan(gradient).any()
        if solver.name == "shift-invert":  # what follows is the same for all, and compiled whole for each
            with pytest.raises(RuntimeError, match="derivative"):
                jax.block_until_ready(jax.jit(jax.grad(partial(loss, throw=True)))(field.tensors))
    messages = [str(warning.message) for warning in told]
    assert any(re.match(r"derivative: the linear solves for \d+ of 2 eigenpairs did not", m) for m in messages)
