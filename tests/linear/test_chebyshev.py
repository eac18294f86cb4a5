"""Chebyshev polynomials of matrices, the heat kernel expanded in them, and bounds on the spectra they are for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.polynomial import chebyshev

from hks_jax.linear.chebyshev import (
    chebyshev_heat_coefficients,
    chebyshev_iteration,
    chebyshev_recurrence,
    coefficient_tails,
    gershgorin,
    lanczos_bound,
    least_degree,
)


def symmetric(values, rng):
    """A matrix with these eigenvalues, and its eigenvectors."""
    vectors = np.linalg.qr(rng.standard_normal((len(values), len(values))))[0]
    return jnp.asarray(vectors * values @ vectors.T), vectors


@pytest.mark.parametrize("degree", [1, 2, 9])
def test_the_recurrence_on_a_tree_of_arrays(rng, degree):
    values = np.linspace(-1, 1, 12)
    matrix, vectors = symmetric(values, rng)
    x = {"one": jnp.asarray(rng.standard_normal((12, 2))), "other": jnp.asarray(rng.standard_normal(12))}
    weights = jnp.asarray(rng.standard_normal(degree + 1))

    def add(n, y, total):
        return total + weights[n] * y["one"]

    y, before, total = chebyshev_recurrence(
        lambda y: jax.tree.map(lambda leaf: matrix @ leaf, y), x, degree, jnp.zeros((12, 2)), add
    )

    def polynomial(coefficients, name):
        return (vectors * chebyshev.chebval(values, coefficients)) @ (vectors.T @ x[name])

    np.testing.assert_allclose(y["other"], polynomial([0] * degree + [1], "other"), atol=1e-13)
    np.testing.assert_allclose(before["one"], polynomial([0] * (degree - 1) + [1], "one"), atol=1e-13)
    np.testing.assert_allclose(total, polynomial(weights, "one"), atol=1e-13)


def test_the_iteration_solves_shifted_systems_as_fast_as_it_should(rng):
    low, high = 2.0, 7.0
    matrix, _ = symmetric(np.linspace(low, high, 20), rng)
    w, shifts = jnp.asarray(rng.standard_normal((20, 3))), jnp.array([-1.0, 0.0, 1.5])
    exact = np.stack([np.linalg.solve(matrix - s * np.eye(20), w[:, i]) for i, s in enumerate(shifts)], axis=1)
    for degree in (4, 12):
        x = -chebyshev_iteration(lambda z: matrix @ z, w, jnp.asarray(low), jnp.asarray(high), shifts, degree)
        residual = np.linalg.norm(w - (matrix @ x - shifts * x), axis=0) / np.linalg.norm(w, axis=0)
        assert (residual <= 1 / np.cosh(degree * np.arccosh((low + high - 2 * shifts) / (high - low)))).all()
        assert (np.linalg.norm(x - exact, axis=0) <= residual * np.linalg.norm(w, axis=0) / (low - shifts)).all()


def test_the_least_degree_keeps_the_error_and_one_less_does_not():
    x = np.linspace(0, 1, 4001)
    for extent, error in ((0.3, 1e-4), (40.0, 1e-8), (900.0, 1e-3)):
        degree = least_degree(extent / 2, error)
        tails = coefficient_tails(extent / 2)
        assert tails[degree + 1] <= error < tails[degree]
        coefficients = chebyshev_heat_coefficients(jnp.array([extent]), 1.0, degree)[0]
        assert np.abs(chebyshev.chebval(2 * x - 1, coefficients) - np.exp(-extent * x)).max() <= error
    assert least_degree(0.0, 1e-8) == 1


@pytest.mark.slow
def test_bounds_on_the_top_of_a_spectrum(rng):
    values = rng.uniform(0, 5, 60)
    matrix, _ = symmetric(values, rng)
    mass = jnp.asarray(rng.uniform(0.5, 2, 60))
    top = np.linalg.eigvalsh(matrix / np.sqrt(mass) / np.sqrt(mass)[:, None])[-1]
    found = lanczos_bound(lambda x: matrix @ x, lambda r: r / mass, mass, 60, 50)
    assert top <= found <= 1.1 * top
    assert top <= gershgorin(matrix, 1 / mass)
    # Exact for a diagonal; and beyond the dimension Lanczos iteration breaks down without harm.
    np.testing.assert_allclose(gershgorin(jnp.diag(mass), jnp.ones(60)), mass.max(), rtol=1e-15)
    assert top <= lanczos_bound(lambda x: matrix @ x, lambda r: r / mass, mass, 60, 80) <= 1.01 * top
