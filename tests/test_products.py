"""Products of blocks of vectors."""

import jax
import numpy as np
import pytest

from hks_jax.linear.products import batched_with_columns


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
