"""Right-hand sides of solves on the complement of known eigenvectors, a few at a time; in JAX."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from hks_jax.eigen.complement.adjoint import norms, wanted_errors
from hks_jax.linear.pencil import SymmetricPencil
from hks_jax.linear.products import combine, even_size, inner_products, products_with_columns, row_blocks

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


# All that is as large as the eigenvectors is computed in place: to fill a new array of that size, whose memory the
# system has to provide, takes as long as products with it.
def projected(
    pencil: SymmetricPencil,
    vectors: Float[Array, "p n_dof"],
    rhs: Float[Array, "k n_dof"],
    tolerance: float,
    amplified: Float[Array, " k"],
) -> tuple[Float[Array, "k n_dof"], Float[Array, " k"]]:
    """Return Q rhs, Q = I − MΦΦᵀ, and the `wanted_errors` of its rows.

    Args:
        pencil: K and M.
        vectors: Φ, as rows.
        rhs: the right-hand sides.
        tolerance: the accuracy of the largest row.
        amplified: how much larger the solution of a row becomes than that of another as large.
    """
    lumped = pencil.mass.diagonal()

    def project(b: Float[Array, "rows n_dof"], _: Array) -> tuple[Float[Array, "rows n_dof"], Float[Array, " rows"]]:
        left = b - pencil.mass.apply(combine(inner_products(vectors, b), vectors))
        return left, norms(left, lumped)

    before = norms(rhs, lumped)
    left, after = _in_parts(project, rhs, before)
    return left, wanted_errors(before, after, jnp.max(before), amplified, tolerance, rhs.dtype)


def cleaned(
    pencil: SymmetricPencil, vectors: Float[Array, "p n_dof"], x: Float[Array, "k n_dof"]
) -> Float[Array, "k n_dof"]:
    """Return x − ΦΦᵀMx, of rows."""

    def clean(x: Float[Array, "rows n_dof"]) -> tuple[Float[Array, "rows n_dof"]]:
        return (x - combine(inner_products(vectors, pencil.mass.apply(x)), vectors),)

    return _in_parts(clean, x)[0]


def _in_parts(project: Callable[..., tuple[Array, ...]], *rows: Array) -> tuple[Array, ...]:
    """Return the projections of rows, of some at a time: of a few of them twice, which changes nothing."""
    size = even_size(len(rows[0]), _ROWS)
    starts, _ = row_blocks(len(rows[0]), size)

    def step(number: Array, rows: tuple[Array, ...]) -> tuple[Array, ...]:
        start = jnp.asarray(starts)[number]
        parts = project(*(jax.lax.dynamic_slice_in_dim(each, start, size) for each in rows))
        whole = zip(rows, parts, strict=True)
        return tuple(jax.lax.dynamic_update_slice_in_dim(each, part, start, axis=0) for each, part in whole)

    return jax.lax.fori_loop(0, len(starts), step, rows)


def solve_in_blocks(
    of_group: Callable[[Int[Array, ""]], Any],
    solve: Callable[..., Float[Array, "n_dof b"]],
    size: int,
    first: Int[np.ndarray, " groups"],
    rhs: Float[Array, "k n_dof"],
    wanted: Float[Array, " k"],
    *of_rows: Float[Array, " k"],
) -> Float[Array, "k n_dof"]:
    """Solve for blocks of rows, one after another.

    Args:
        of_group: returns what the blocks of a group share.
        solve: returns x for (what the group shares, rhs, wanted, *of_rows) of one block; x and rhs are columns.
        size: rows of a block.
        first: the first row of each group of blocks.
        rhs: the right-hand sides.
        wanted: the error wanted of each; where it is infinite there is nothing to solve.
        of_rows: more arrays, with an entry for each row.
    """
    size = min(size, len(rhs))
    starts, _ = row_blocks(len(rhs), size)
    blocks = jnp.asarray(np.append(first // size, len(starts)))

    def solve_group(group: Array, x: Float[Array, "k n_dof"]) -> Float[Array, "k n_dof"]:
        shared = of_group(group)

        def solve_block(number: Array, x: Float[Array, "k n_dof"]) -> Float[Array, "k n_dof"]:
            start = jnp.asarray(starts)[number]
            b, error, *own = (jax.lax.dynamic_slice_in_dim(each, start, size) for each in (x, wanted, *of_rows))
            unsolved = start + np.arange(size) >= number * size  # the last block may overlap the one before
            solution = solve(shared, b.T, jnp.where(unsolved, error, jnp.inf), *own).T
            return jax.lax.dynamic_update_slice_in_dim(x, jnp.where(unsolved[:, None], solution, b), start, axis=0)

        return jax.lax.fori_loop(blocks[group], blocks[group + 1], solve_block, x)

    return jax.lax.fori_loop(0, len(first), solve_group, rhs)
