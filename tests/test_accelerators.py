"""Programs as they are arranged for accelerators, run on a CPU."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fields import random_spd

import hks_jax as hj
from hks_jax.linear import accelerators
from hks_jax.linear.orthonormal_kernel import cholesky_and_inverse


@pytest.fixture
def as_on_an_accelerator(monkeypatch):
    jax.clear_caches()
    monkeypatch.setattr(accelerators, "at_hand", lambda: True)
    yield
    jax.clear_caches()


def residual_and_orthogonality(pairs):
    K, M = (np.asarray(matrix.to_dense()) for matrix in (pairs.pencil.stiffness, pairs.pencil.mass))
    vectors, values = np.asarray(pairs.vectors), np.asarray(pairs.eigenvalues)
    defect = np.abs(vectors @ K - values[:, None] * (vectors @ M)).max() / np.abs(values).max()
    return defect, np.abs(vectors @ M @ vectors.T - np.eye(pairs.k)).max()


@pytest.mark.slow
@pytest.mark.parametrize("traced", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_block_lanczos_in_several_slices(rng, as_on_an_accelerator, traced):
    field = hj.TensorField(hj.Grid((18, 16), 0.1), random_spd(rng, (18, 16)))
    solve = partial(hj.eigenpairs, k=24, solver=hj.BlockLanczos(block=4, slice_size=12))
    pairs = jax.jit(solve)(field) if traced else solve(field)
    assert pairs.complete_below > pairs.eigenvalues[-1]
    assert pairs.converged.all()
    defect, orthogonality = residual_and_orthogonality(pairs)
    assert defect < 1e-9
    assert orthogonality < 1e-9


@pytest.mark.slow
def test_refined_solves_are_those_of_cpus(rng, monkeypatch):
    """On a thin domain factorisations are inaccurate, and solves repeated."""
    field = hj.TensorField(hj.Grid((4, 200), (0.01, 1.0)), jnp.broadcast_to(jnp.eye(2), (4, 200, 2, 2)))
    values = []
    for answer in (False, True):
        monkeypatch.setattr(accelerators, "at_hand", lambda answer=answer: answer)
        jax.clear_caches()
        with pytest.warns(hj.AccuracyWarning):
            values.append(hj.eigenpairs(field, 7, solver="block-lanczos").eigenvalues)
    np.testing.assert_allclose(*values, atol=1e-6 * values[0][1])


@pytest.mark.parametrize(("b", "dtype"), [(1, float), (8, float), (8, np.float32), (20, float)])
def test_factor_of_a_gram_matrix(rng, b, dtype):
    x = (rng.standard_normal((100, b)) * 10.0 ** rng.uniform(-3, 3, b)).astype(dtype)
    products = x.T @ x
    factor, change = cholesky_and_inverse(jnp.asarray(products), interpret=True)
    norms, eps = np.sqrt(np.diag(products)), np.finfo(dtype).eps
    np.testing.assert_allclose(
        factor @ factor.T / norms / norms[:, None], products / norms / norms[:, None], atol=50 * eps
    )
    np.testing.assert_allclose((x @ change).T @ (x @ change), np.eye(b), atol=1e4 * eps)
    np.testing.assert_allclose(factor.T @ change, np.eye(b), atol=1e3 * eps)


def test_dependent_columns_become_orthonormal_in_two_passes(rng):
    x = rng.standard_normal((100, 8))
    x[:, 5] = x[:, 2] + 1e-13 * x[:, 5]
    x[:, 6] = x[:, 0] - 3 * x[:, 1]
    x[:, 7] = 0
    for _ in range(2):
        _, change = cholesky_and_inverse(jnp.asarray(x.T @ x), interpret=True)
        x = x @ np.asarray(change)
    products = x.T @ x
    assert np.isfinite(x).all()
    np.testing.assert_allclose(products[:5, :5], np.eye(5), atol=1e-8)
    assert np.abs(products).max() < 10
