"""Inverses and inertia of batches of indefinite matrices, as CPUs and accelerators compute them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hks_jax.linear.symmetric_inverse import by_cholesky_factors, by_eigenvalues, by_elimination

WAYS = {"cpu": by_eigenvalues, "accelerator": by_elimination}


def of_spectrum(rng, values):
    """Return matrices with these eigenvalues, (m, n), and random eigenvectors."""
    frames = np.linalg.qr(rng.standard_normal((*values.shape, values.shape[-1])))[0]
    a = np.einsum("mij,mj,mkj->mik", frames, values, frames)
    return (a + np.swapaxes(a, 1, 2)) / 2


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("n", [1, 75, *(pytest.param(n, marks=pytest.mark.slow) for n in (7, 32, 200))])
def test_inverse_and_inertia_of_indefinite_matrices(rng, way, n):
    a = rng.standard_normal((3, n, n))
    a = a + np.swapaxes(a, 1, 2)
    inverted, pivots = jax.jit(WAYS[way])(jnp.asarray(a), jnp.zeros(3))
    np.testing.assert_allclose(inverted @ a, np.broadcast_to(np.eye(n), a.shape), atol=1e-8)
    np.testing.assert_array_equal((pivots < 0).sum(axis=1), (np.linalg.eigvalsh(a) < 0).sum(axis=1))
    np.testing.assert_allclose(jnp.sum(jnp.log(jnp.abs(pivots)), axis=1), np.linalg.slogdet(a)[1], rtol=1e-10)


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("n", [24, pytest.param(100, marks=pytest.mark.slow)])
def test_inertia_of_nearly_singular_matrices(rng, way, n):
    """Some eigenvalues a millionth of the others, of either sign, in a batch of one that is definite."""
    values = rng.choice([-1.0, 1.0], (8, n)) * rng.uniform(0.5, 2, (8, n))
    values[0] = np.abs(values[0])
    values[1:, :2] *= 1e-6
    a = of_spectrum(rng, values)
    inverted, pivots = jax.jit(WAYS[way])(jnp.asarray(a), jnp.zeros(8))
    np.testing.assert_array_equal((pivots < 0).sum(axis=1), (values < 0).sum(axis=1))
    np.testing.assert_allclose(inverted @ a, np.broadcast_to(np.eye(n), a.shape), atol=1e-5)


@pytest.mark.parametrize("negative", [0, 3])
def test_definite_matrices_and_a_batch_of_which_one_is_not(rng, negative):
    values = rng.uniform(0.5, 2, (5, 24))
    values[2, :negative] *= -1
    a = of_spectrum(rng, values)
    inverted, pivots = jax.jit(by_cholesky_factors)(jnp.asarray(a), jnp.zeros(5))
    np.testing.assert_allclose(inverted @ a, np.broadcast_to(np.eye(24), a.shape), atol=1e-13)
    np.testing.assert_array_equal((pivots < 0).sum(axis=1), [0, 0, negative, 0, 0])


@pytest.mark.parametrize("way", WAYS)
def test_no_pivot_is_smaller_than_the_least_allowed(way):
    """The zero of a singular matrix is taken for a positive number, that small."""
    a = jnp.asarray(np.diag([3.0, 0.0, -2.0, 1e-12])[None])
    inverted, pivots = jax.jit(WAYS[way])(a, jnp.full(1, 1e-3))
    np.testing.assert_allclose(np.sort(pivots[0]), [-2, 1e-3, 1e-3, 3], rtol=1e-12)
    np.testing.assert_allclose(inverted[0], np.diag([1 / 3, 1e3, -0.5, 1e3]), rtol=1e-12)


@pytest.mark.slow
def test_elimination_under_vmap(rng):
    a = rng.standard_normal((2, 3, 20, 20))
    a = a + np.swapaxes(a, 2, 3)
    inverted, _ = jax.vmap(by_elimination)(jnp.asarray(a), jnp.zeros((2, 3)))
    np.testing.assert_allclose(inverted @ a, np.broadcast_to(np.eye(20), a.shape), atol=1e-8)
