"""Products of blocks of vectors."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hks_jax.linear.linear_map import with_transpose
from hks_jax.linear.products import batched_with_columns, of_each_row


@pytest.mark.parametrize("count", [3, 600])
def test_products_of_few_and_of_many_matrices_with_columns(rng, count):
    matrices, columns = rng.standard_normal((count, 7, 5)), rng.standard_normal((count, 5, 2))
    products = jax.jit(batched_with_columns)(matrices, columns)
    np.testing.assert_allclose(products, np.einsum("mij,mjb->mib", matrices, columns), rtol=1e-13, atol=1e-13)


def test_what_is_not_finite_stays_in_its_column(rng):
    matrices, columns = rng.standard_normal((600, 7, 5)), rng.standard_normal((600, 5, 2))
    columns[:, :, 0] = np.nan
    products = jax.jit(batched_with_columns)(matrices, columns)
    assert np.isnan(products[..., 0]).all()
    np.testing.assert_allclose(
        products[..., 1], np.einsum("mij,mj->mi", matrices, columns[..., 1]), rtol=1e-13, atol=1e-13
    )


@pytest.mark.parametrize("count", [1, 8, 11])
@pytest.mark.parametrize("length", [100, 40_000])
def test_functions_of_each_row_and_what_belongs_to_them_in_derivatives(rng, count, length):
    rows, images, factors = (rng.standard_normal(shape) for shape in ((count, length), (count, length), length))

    def product(factors, rows):
        return of_each_row(lambda row: factors * jnp.roll(row, 1), rows)

    y, back = jax.vjp(jax.jit(product), factors, rows)
    np.testing.assert_array_equal(y, factors * np.roll(rows, 1, axis=1))
    of_factors, of_rows = back(jnp.asarray(images))
    np.testing.assert_allclose(of_factors, np.sum(images * np.roll(rows, 1, axis=1), axis=0), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(of_rows, np.roll(factors * images, -1, axis=1), rtol=1e-14)


@pytest.mark.slow
def test_a_transpose_of_ones_own_is_differentiated_by_what_its_cotangents_depend_on(rng):
    """What `jax.jacfwd` of `jax.grad` takes, for the parameters of a loss."""
    A, x = jnp.asarray(rng.standard_normal((3, 4))), jnp.asarray(rng.standard_normal(4))

    def loss(x, t):
        return jnp.sum((t * with_transpose(lambda x: A @ x, lambda y: A.T @ y, x)) ** 3)

    got = jax.jacfwd(lambda t: jax.grad(loss)(x, t))(2.0)
    np.testing.assert_allclose(got, 9 * 2.0**2 * A.T @ (A @ x) ** 2, rtol=1e-13)
