"""Functions of small symmetric matrices against SciPy's, where eigenvalues are apart, close, and equal."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fields import random_spd
from scipy.linalg import expm, expm_frechet

from hks_jax.domain import spd


def matrices(rng, d, spread):
    """Symmetric matrices with eigenvalues within ±spread of 0.3; of half of them two are equal."""
    frames = np.linalg.qr(rng.standard_normal((8, d, d)))[0]
    values = rng.uniform(-spread, spread, (8, d))
    values[:4, 1] = values[:4, 0]
    found = np.einsum("nia,na,nja->nij", frames, values + 0.3, frames)
    return (found + np.swapaxes(found, 1, 2)) / 2


@partial(jax.jit, static_argnums=0)
def along(f, x, direction):
    return jax.jvp(f, (x,), (direction,))


@jax.jit
def pulled_back(S, weights):
    return jax.grad(lambda S: jnp.vdot(spd.exp(S), weights))(S)


@pytest.mark.parametrize("spread", [0.0, 1e-9, 1e-4, 0.2, 2.0])
@pytest.mark.parametrize("d", [2, 3])
def test_exponential_logarithm_and_their_derivatives_agree_with_scipy(rng, d, spread):
    S = matrices(rng, d, spread)
    direction = rng.standard_normal(S.shape)
    direction = direction + np.swapaxes(direction, 1, 2)
    expected = expm(S)
    slope = np.stack([expm_frechet(a, b, compute_expm=False) for a, b in zip(S, direction, strict=True)])
    got, got_slope = along(spd.exp, S, direction)
    np.testing.assert_allclose(got, expected, atol=1e-13 * np.abs(expected).max())
    np.testing.assert_allclose(got_slope, slope, atol=1e-13 * np.abs(slope).max())
    # The logarithm undoes both; its own derivative is applied to that of the exponential.
    back, back_slope = along(spd.log, expected, slope)
    np.testing.assert_allclose(back, S, atol=1e-12)
    np.testing.assert_allclose(back_slope, direction, atol=1e-11)
    gradient = pulled_back(S, direction)
    np.testing.assert_allclose(gradient, slope, atol=1e-13 * np.abs(slope).max())


def test_large_and_small_exponents():
    for values in ([300.0, -300.0], [300.0, -250.0, 10.0], [1e-12, 0.0, -1e-12]):
        got = np.diag(spd.exp(jnp.diag(jnp.asarray(values))))
        np.testing.assert_allclose(got, np.exp(values), rtol=1e-12, atol=1e-12 * np.exp(max(values)))


@pytest.mark.slow
def test_second_derivatives_where_eigenvalues_are_equal():
    """exp(S + hD) = exp S (1 + hD + h²D²/2 + …) where S is a multiple of the identity."""
    D2, D3 = np.array([[0.3, 0.7], [0.7, -1.1]]), np.array([[0.3, 0.7, 0.1], [0.7, -1.1, 0.2], [0.1, 0.2, 0.5]])

    @partial(jax.jit, static_argnums=0)
    def second(f, at, D):
        return jax.jvp(lambda x: jax.jvp(f, (x,), (D,))[1], (at,), (D,))[1]

    np.testing.assert_allclose(second(spd.exp, 0.4 * np.eye(2), D2), np.exp(0.4) * D2 @ D2, rtol=1e-13)
    np.testing.assert_allclose(second(spd.log, 2 * np.eye(2), D2), -D2 @ D2 / 4, rtol=1e-13)
    np.testing.assert_allclose(second(spd.exp, 0.4 * np.eye(3), D3), np.exp(0.4) * D3 @ D3, rtol=1e-12)


def test_no_logarithm_of_what_is_not_positive_definite():
    for bad in (-jnp.eye(2), jnp.asarray([[1.0, 2.0], [2.0, 1.0]]), -jnp.eye(3), jnp.diag(jnp.asarray([1.0, -1, -1]))):
        assert np.isnan(spd.log(bad)).any()


def test_cholesky_factors_of_definite_and_semidefinite_matrices(rng):
    t = jnp.asarray(random_spd(rng, (4, 5, 6)))
    np.testing.assert_allclose(spd.cholesky(t), np.linalg.cholesky(t), atol=1e-14)
    thin, indefinite = jnp.diag(jnp.array([1.0, 1e-14])), jnp.array([[1.0, 2.0], [2.0, 1.0]])
    np.testing.assert_allclose(spd.cholesky(thin), jnp.sqrt(thin), rtol=1e-14)
    assert np.isnan(spd.cholesky(indefinite)).any()
    root = spd.cholesky(jnp.ones((2, 2)), negligible=1e-12)
    np.testing.assert_array_equal(root, [[1, 0], [1, 0]])
