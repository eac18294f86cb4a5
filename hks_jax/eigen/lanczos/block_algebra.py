"""What the recurrence does with blocks of a few columns: with XLA's operations, or by kernels where they compile."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.linear import column_kernels, lapack
from hks_jax.linear.operators import OfColumns
from hks_jax.linear.products import gram, times


def recur(
    block: Float[Array, "n_dof b"],
    image: Float[Array, "n_dof b"],
    before: Float[Array, "n_dof b"],
    coupling: Float[Array, "b b"],
    x: Float[Array, "n_dof b"],
) -> tuple[Float[Array, "n_dof b"], Float[Array, "b b"]]:
    """Return x = (K − σM)⁻¹M · block without that block and the one before, and what it has in the block itself."""

    def plain() -> tuple[Array, Array]:
        diagonal = gram(image, x)
        diagonal = (diagonal + diagonal.T) / 2
        return x - times(block, diagonal) - times(before, coupling), diagonal

    def by_kernels() -> tuple[Array, Array]:
        parts = column_kernels.parts_of_products(image, x)
        return column_kernels.remainder(x, block, parts, (before, coupling))

    return _one_of(by_kernels, plain, x)


def without(
    block: Float[Array, "n_dof b"], image: Float[Array, "n_dof b"], x: Float[Array, "n_dof b"]
) -> Float[Array, "n_dof b"]:
    """Return x without what it has of M-orthonormal columns, given also their image under M."""

    def by_kernels() -> Array:
        return column_kernels.remainder(x, block, column_kernels.parts_of_products(image, x))[0]

    return _one_of(by_kernels, lambda: x - times(block, gram(image, x)), x)


def orthonormal(
    mass: OfColumns, x: Float[Array, "n_dof b"]
) -> tuple[Float[Array, "n_dof b"], Float[Array, "n_dof b"], Float[Array, "b b"]]:
    """Return M-orthonormal columns y, My, and the factor R of x = yRᵀ.

    The inner products are factorised by their eigenvalues; in kernels, for which these take long, by a pivoted Cholesky
    factorisation. Of what rounding leaves nothing becomes infinite.
    """
    identity = jnp.asarray(np.eye(x.shape[1], dtype=x.dtype))  # a constant, which no kernel has to compute

    def plain() -> tuple[Array, Array, Array]:
        y, total = x, identity
        for _ in range(2):
            image = mass(y)
            factor, change = _factored(gram(y, image))
            y = times(y, change)
            total = times(total, factor)
        return y, times(image, change), total

    def by_kernels() -> tuple[Array, Array, Array]:
        parts = column_kernels.parts_of_products(x, mass(x))
        (y,), total = column_kernels.orthonormal(parts, (x,), identity)
        image = mass(y)
        parts = column_kernels.parts_of_products(y, image)
        (y, image), total = column_kernels.orthonormal(parts, (y, image), total)
        return y, image, total

    return _one_of(by_kernels, plain, x)


def _one_of(by_kernels: Callable[[], Any], plain: Callable[[], Any], x: Float[Array, "n_dof b"]) -> Any:
    if x.shape[1] <= column_kernels.LARGEST and column_kernels.agree(x.dtype):
        return jax.lax.platform_dependent(cuda=by_kernels, default=plain)
    return plain()


def _factored(products: Float[Array, "b b"]) -> tuple[Float[Array, "b b"], Float[Array, "b b"]]:
    """Return F with FFᵀ = G, the inner products, and F⁻ᵀ."""
    norms = jnp.sqrt(jnp.diagonal(products))
    norms = jnp.where(norms > 0, norms, 1)
    sizes, mix = lapack.eigh(products / norms[None] / norms[:, None])
    sizes = jnp.sqrt(jnp.maximum(sizes, jnp.finfo(products.dtype).eps * sizes[-1]))
    return norms[:, None] * mix * sizes[None], mix / sizes[None] / norms[:, None]
