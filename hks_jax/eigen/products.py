"""Products of blocks of vectors, as XLA computes them fastest."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

_NODES = 2048
"""Columns of a basis combined at once: its rows and what comes of them stay in the cache."""


def inner_products(basis: Float[Array, "m n"], block: Float[Array, "b n"]) -> Float[Array, "b m"]:
    """Return the inner products.

    XLA's CPU kernels for a long contraction are many times faster with the large factor on the left, and for what
    comes after with the small one there and not transposed; the barriers keep XLA from turning either round.
    """
    products = jax.lax.optimization_barrier(jnp.matmul(basis, block.T, precision="highest"))
    return jax.lax.optimization_barrier(products.T)


def combine(mix: Float[Array, "q m"], basis: Float[Array, "m n"]) -> Float[Array, "q n"]:
    """Return linear combinations of the basis."""
    return jnp.matmul(mix, basis, precision="highest")


def combine_pieces(mix: Float[Array, "q m"], basis: tuple[Float[Array, "rows n"], ...]) -> Float[Array, "q n"]:
    """Return many linear combinations of a basis that is kept in pieces."""
    n = basis[0].shape[1]
    width = min(_NODES, n)
    mixes = jnp.split(mix, np.cumsum([len(rows) for rows in basis])[:-1], axis=1)

    def some(number: Array, found: Float[Array, "q n"]) -> Float[Array, "q n"]:
        at = jnp.minimum(number * width, n - width)  # the last may overlap the one before
        pieces = [jax.lax.dynamic_slice_in_dim(rows, at, width, axis=1) for rows in basis]
        sums = sum(map(combine, mixes, pieces), jnp.zeros((), mix.dtype))
        return jax.lax.dynamic_update_slice_in_dim(found, sums, at, axis=1)

    return jax.lax.fori_loop(0, -(-n // width), some, jnp.zeros((len(mix), n), mix.dtype))


def components(basis: Float[Array, "m n"], images: Float[Array, "n c"]) -> Float[Array, "c n"]:
    """Return what columns, whose images under the inner product are given, have in an orthonormal basis, as rows."""
    products = jax.lax.optimization_barrier(jnp.matmul(basis, images, precision="highest"))
    return combine(products.T, basis)


def gram(x: Float[Array, "n b"], y: Float[Array, "n c"]) -> Float[Array, "b c"]:
    """Return the inner products of columns."""
    return jnp.matmul(x.T, y, precision="highest")


def times(x: Float[Array, "n b"], mix: Float[Array, "b c"]) -> Float[Array, "n c"]:
    """Return linear combinations of columns."""
    return jnp.matmul(x, mix, precision="highest")
