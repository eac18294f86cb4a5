"""Products of blocks of vectors, as XLA computes them fastest."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


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
