"""Conjugate gradients begin again where rounding leads them out of the subspace in which matrices are definite."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hks_jax as hj
from hks_jax.eigen.adjoints.complement import amplification, projected
from hks_jax.eigen.adjoints.factorised_adjoint import FactorisedAdjoint
from hks_jax.eigen.shift_invert.host_adjoint import _solve as solve_on_host
from hks_jax.linear.conjugate_gradients import conjugate_gradients
from hks_jax.linear.host_matrices import host_matrices


def definite_beyond_the_first(n, columns):
    """Return the eigenvalues for each column, of which the first alone is negative."""
    return jnp.asarray(np.append(-8.0, np.linspace(1, 3, n - 1))[:, None] * np.linspace(1, 1.2, columns))


def product_of(values):
    return lambda x: (values * x, 1e-8 * jnp.sum(x * x, axis=0))


def without_the_first(x):
    return x.at[0].set(0)


@pytest.mark.slow
def test_rounding_in_a_negative_direction_is_taken_out(rng):
    """A preconditioner that errs there as by rounding: what the product makes of it grows from step to step."""
    values = definite_beyond_the_first(20, 3)
    product = product_of(values)
    rhs = without_the_first(jnp.asarray(rng.standard_normal((20, 3))))

    def precondition(r):
        return r.at[0].add(1e-8 * jnp.sum(jnp.abs(r), axis=0))

    wanted = jnp.full(3, 1e-10)
    assert np.isnan(conjugate_gradients(product, precondition, rhs, wanted).converged).any()
    x = without_the_first(conjugate_gradients(product, precondition, rhs, wanted, clean=without_the_first).converged)
    np.testing.assert_allclose(x, rhs / values, rtol=0, atol=1e-9)


def test_a_singular_matrix_is_told_however_often_it_begins_again(rng):
    values = definite_beyond_the_first(20, 3).at[5].set(0)
    rhs = without_the_first(jnp.asarray(rng.standard_normal((20, 3))))
    x = conjugate_gradients(product_of(values), lambda r: r, rhs, jnp.full(3, 1e-8), clean=without_the_first).converged
    assert np.isnan(x).all()


@pytest.mark.slow
def test_residuals_of_pure_rounding_are_no_failure(rng):
    """Two eigenvalues: the third residual is rounding, and what the preconditioner makes of it may be negative."""
    values, rhs = np.repeat([1.0, 3.0], 10)[:, None], rng.standard_normal((20, 2))
    turns = 0

    def precondition(r):
        nonlocal turns
        turns += 1
        return -r if turns == 3 else r

    def product(x):
        return values * x, 1e-8 * (x * x).sum(axis=0)

    for xp in (np, jnp):
        turns = 0
        x = conjugate_gradients(product, precondition, xp.asarray(rhs), xp.full(2, 1e-12)).converged
        np.testing.assert_allclose(x, rhs / values, rtol=1e-13)
    # A negative product of a residual that is not yet small is a failure.
    turns = 1
    assert np.isnan(conjugate_gradients(product, precondition, rhs, np.full(2, 1e-12)).converged).all()


@pytest.mark.slow
def test_rows_far_from_their_shift_converge():
    """Known eigenvectors outside of those taken out in each step grow by rounding, until they spoil the last digits."""
    grid = hj.Grid((64, 64), 1 / 63)
    x, y = np.moveaxis(grid.nodes, -1, 0)
    bump = 0.3 * np.exp(-((x - 0.6) ** 2 + (y - 0.4) ** 2) / 0.02)
    factor = np.exp(0.5 * np.sin(2 * np.pi * x) * np.cos(np.pi * y) + bump)
    tensors = jnp.asarray(factor[..., None, None] * np.eye(2))
    pencil = hj.assemble(hj.TensorField(grid, tensors))
    solver, adjoint, k = hj.BlockLanczos(), FactorisedAdjoint(1e-11), 147
    values, vectors, _ = solver.lowest(pencil, k + 10)
    prepared = adjoint.prepare(pencil, values, k)
    data, matrices = host_matrices(pencil)
    stiffness, mass = matrices(*data)

    @jax.jit
    def matrices_of(tensors):
        assembled = hj.assemble(hj.TensorField(grid, tensors))
        return assembled.stiffness, assembled.mass

    functions = vectors[:k]
    for seed in range(3):
        noise = np.random.default_rng(seed).standard_normal(grid.shape)[..., None, None]
        _, (d_stiffness, d_mass) = jax.jvp(matrices_of, (tensors,), (tensors * noise,))
        rhs = values[:k, None] * d_mass.apply(functions) - d_stiffness.apply(functions)
        rhs = rhs.at[0].set(0)
        ours = np.asarray(adjoint.solve(prepared, pencil, values, vectors, rhs))
        assert np.isfinite(ours).all()
        reference = solve_on_host(
            stiffness, mass, np.asarray(values), np.asarray(vectors), np.asarray(rhs), 1e-13, np.dtype(np.float64)
        )
        _, wanted = projected(pencil, vectors, rhs, adjoint.tolerance, amplification(values, k))
        norms = [
            np.sqrt(np.einsum("kn,kn->k", e, (stiffness @ e.T - (mass @ e.T) * np.asarray(values[:k])).T))
            for e in (ours - reference, reference)
        ]
        assert (norms[0][1:] < 1.5 * np.asarray(wanted[1:]) * norms[1][1:]).all()
