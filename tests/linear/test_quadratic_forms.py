"""Quadratic forms of many vectors at once, against their definition."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hks_jax.linear.products import quadratic_forms

SHAPES = [(3, 5, 40), (2, 70, 2048), (3, 130, 5000), (1, 1, 1)]
"""Matrices, functions and points: one block or several, and points that the last few share with those before."""


def problem(rng, shape, dtype=float):
    """Return symmetric matrices that vanish between functions that do not matter, vectors, and what matters."""
    m, k, n = shape
    matrices = rng.normal(size=(m, k, k))
    matters = np.arange(k) < rng.integers(0, k + 1, size=m)[:, None]
    matters[0] = True
    matrices = (matrices + matrices.swapaxes(1, 2)) * (matters[:, :, None] | matters[:, None, :])
    return tuple(map(jnp.asarray, (matrices.astype(dtype), rng.normal(size=(k, n)).astype(dtype), matters)))


@pytest.mark.parametrize(("shape", "dtype"), list(zip(SHAPES, [np.float32, np.float64] * 2, strict=True)))
def test_values(rng, shape, dtype):
    matrices, vectors, matters = problem(rng, shape, dtype)
    expected = np.einsum("mij,in,jn->mn", *(np.asarray(x, float) for x in (matrices, vectors, vectors)), optimize=True)
    got = jax.jit(quadratic_forms)(matrices, vectors, matters)
    assert got.dtype == dtype
    np.testing.assert_allclose(got, expected, atol=20 * np.finfo(dtype).eps * np.abs(expected).max())


@pytest.mark.parametrize("shape", [SHAPES[1], *(pytest.param(SHAPES[i], marks=pytest.mark.slow) for i in (0, 2))])
def test_transpose(rng, shape):
    """Of symmetric matrices: the transpose may have their upper triangle alone, twice."""
    matrices, vectors, matters = problem(rng, shape)
    weights = jnp.asarray(rng.normal(size=(shape[0], shape[2])))
    (got,) = jax.jit(jax.linear_transpose(lambda c: quadratic_forms(c, vectors, matters), matrices))(weights)
    expected = np.einsum("mn,in,jn->mij", weights, vectors, vectors, optimize=True)
    counts = np.asarray(matters[:, :, None] | matters[:, None, :])
    both = np.asarray(got + jnp.swapaxes(got, 1, 2))
    np.testing.assert_allclose(counts * both, counts * 2 * expected, atol=1e-13 * np.abs(expected).max())


def test_rows_that_do_not_matter_are_left_out(rng):
    """That is where the time is saved; what stands there does not count."""
    matrices, vectors, _ = problem(rng, (2, 130, 50))
    matters = jnp.arange(130) < jnp.asarray([[64], [0]])
    run = jax.jit(quadratic_forms)
    expected = run(matrices.at[0, 64:, 64:].set(0), vectors, jnp.ones_like(matters))[0]
    spoiled = matrices.at[0, 64:, 64:].set(np.nan).at[1].set(np.nan)
    got = run(spoiled, vectors, matters)
    np.testing.assert_allclose(got[0], expected, atol=1e-12 * np.abs(expected).max())
    np.testing.assert_array_equal(got[1], 0)


@pytest.mark.slow
def test_under_jit_and_vmap(rng):
    problems = [problem(rng, (3, 70, 30)) for _ in range(2)]
    batch = jax.tree.map(lambda *x: jnp.stack(x), *problems)
    together, alone = jax.jit(jax.vmap(quadratic_forms))(*batch), jax.jit(quadratic_forms)
    np.testing.assert_allclose(together, np.stack([alone(*one) for one in problems]), atol=1e-12)
