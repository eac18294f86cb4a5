"""Right-hand sides of solves on the complement of known eigenvectors, a few at a time; in JAX."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.eigen.complement.common import norms, wanted_errors
from hks_jax.linear.pencil import SymmetricPencil
from hks_jax.linear.products import combine, inner_products, products_with_columns

_ROWS = 128
"""Rows that the known eigenvectors are taken out of at once: fewer read them more often from memory."""


def without_known(
    pencil: SymmetricPencil, vectors: Float[Array, "p n_dof"]
) -> Callable[[Float[Array, "n_dof b"]], Float[Array, "n_dof b"]]:
    """Return x ↦ x − ΦΦᵀMx, of columns."""
    mass = pencil.mass.of_columns()

    def without(x: Float[Array, "n_dof b"]) -> Float[Array, "n_dof b"]:
        return x - combine(products_with_columns(vectors, mass(x)).T, vectors).T

    return without


# No array but the right-hand sides and the solution is as large as the eigenvectors.
def solve_in_blocks(
    solve: Callable[..., Float[Array, "b n_dof"]],
    size: int,
    pencil: SymmetricPencil,
    vectors: Float[Array, "p n_dof"],
    rhs: Float[Array, "k n_dof"],
    tolerance: float,
    amplified: Float[Array, " k"],
    clean: bool,
    *of_rows: Float[Array, " k"],
) -> Float[Array, "k n_dof"]:
    """Solve for blocks of rows, one after another, on the complement of the eigenvectors Φ.

    Args:
        solve: returns x for (number, Q rhs, wanted, *of_rows) of one block, Q = I − MΦΦᵀ.
        size: rows of a block.
        pencil: K and M.
        vectors: Φ, as rows.
        rhs: the right-hand sides.
        tolerance: the accuracy of the largest row.
        amplified: how much larger the solution of a row becomes than that of another as large.
        clean: whether x has nothing of Φ that counts; else it is taken out.
        of_rows: what else there is of each row.
    """
    k, lumped = len(rhs), pencil.mass.diagonal()
    count, parts = -(-k // size), -(-k // _ROWS)
    blocks = -(-count // parts)
    before = norms(rhs, lumped)
    largest = jnp.max(before)

    def solve_part(part: tuple[Array, ...]) -> Float[Array, "rows n_dof"]:
        number, at, before, amplified, *own = part
        b = rhs.at[at].get(mode="clip")
        left = b - pencil.mass.apply(combine(inner_products(vectors, b), vectors))
        wanted = wanted_errors(before, norms(left, lumped), largest, amplified, tolerance, rhs.dtype)
        wanted = jnp.where(at < k, wanted, jnp.inf)
        own = [rows.reshape(blocks, size, *rows.shape[1:]) for rows in (left, wanted, *own)]
        x = jax.lax.map(lambda block: solve(*block), (number, *own)).reshape(b.shape)
        return x if clean else x - combine(inner_products(vectors, pencil.mass.apply(x)), vectors)

    # The last part is filled up with rows that have nothing to solve.
    number = np.minimum(np.arange(parts * blocks), count - 1).reshape(parts, blocks)
    at = np.arange(parts * blocks * size).reshape(parts, -1)
    own = [rows[np.minimum(at, k - 1)] for rows in (before, amplified, *of_rows)]
    x = jax.lax.map(solve_part, (jnp.asarray(number), jnp.asarray(at), *own))
    return x.reshape(at.size, -1)[:k]
