"""Conjugate gradients for one ill-conditioned matrix, with residuals that stay orthogonal in spite of rounding."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

_MOST, _MEMORY = 400, 4e8
"""Residuals that are kept at most, and bytes that they may take."""


class Solution(NamedTuple):
    """What conjugate gradients have come to.

    Attributes:
        x: the solution; NaN where a product is.
        rhs: the right-hand side.
        steps: how many there were.
    """

    x: Float[Array, " n"]
    rhs: Float[Array, " n"]
    steps: Int[Array, ""]


class _Iteration(NamedTuple):
    """The state after some steps.

    Attributes:
        x: the solution so far.
        rhs: the right-hand side.
        r: its residual.
        z: Pr.
        p: the next direction.
        size: rᵀPr.
        enough: what it may be at the end.
        residuals: the residuals of all steps, divided by √(rᵀPr); zero where there is none yet.
        preconditioned: P times them.
        steps: how many; −1 before the right-hand side is known.
        going: whether there is a next one.
    """

    x: Float[Array, " n"]
    rhs: Float[Array, " n"]
    r: Float[Array, " n"]
    z: Float[Array, " n"]
    p: Float[Array, " n"]
    size: Float[Array, ""]
    enough: Float[Array, ""]
    residuals: Float[Array, "m n"]
    preconditioned: Float[Array, "m n"]
    steps: Int[Array, ""]
    going: Bool[Array, ""]


# In exact arithmetic rᵢᵀPrⱼ = 0. Rounding loses that as soon as an eigenvector at the end of the spectrum is known, and
# conjugate gradients then look for it again and again: where eigenvalues fall off over eight decades, that doubles the
# number of steps. The products with A being dear and n small, it is cheaper to restore it (Paige 1971; Simon 1984).
def orthogonal_conjugate_gradients(
    product: Callable[[Float[Array, " n"], Bool[Array, ""]], Float[Array, " n"]],
    precondition: Callable[[Float[Array, " n"]], Float[Array, " n"]],
    like: Float[Array, " n"],
    tolerance: Float[Array, ""],
    most: Int[Array, ""],
) -> Solution:
    """Solve Ax = b until the residual r = b − Ax has √(rᵀPr) below a tolerance, or for so many steps.

    Where P resembles A⁻¹ up to a factor, that norm of the residual is the energy norm √(eᵀAe) of the error, relative to
    that of x. Each step takes one product with A.

    Args:
        product: (x, first) ↦ b where ``first``, else Ax, A symmetric and positive definite. What the two have in
            common is compiled once.
        precondition: r ↦ Pr, an approximation of A⁻¹r up to a factor, symmetric and positive definite.
        like: an array of the shape and dtype of b.
        tolerance: relative to √(bᵀPb).
        most: steps after which to stop all the same; with none of them x is zero.
    """
    (n,), dtype = like.shape, like.dtype
    kept = max(min(n, _MOST, int(_MEMORY / (2 * n * dtype.itemsize))), 1)

    def step(state: _Iteration) -> _Iteration:
        x, rhs, r, z, p, before, enough, residuals, preconditioned, steps, _ = state
        first = steps < 0
        image = product(p, first)
        rhs = jnp.where(first, image, rhs)
        length = jnp.where(first, -1, before / jnp.where(first, 1, jnp.vdot(p, image)))
        # When all places are taken the last one is used again: what is lost first was known first.
        at, root = jnp.clip(steps, 0, kept - 1), jnp.sqrt(before)
        residuals, preconditioned = residuals.at[at].set(r / root), preconditioned.at[at].set(z / root)
        r = r - length * image
        r = r - jnp.matmul(jnp.matmul(preconditioned, r, precision="highest"), residuals, precision="highest")
        z = precondition(r)
        size = jnp.vdot(r, z)
        enough = jnp.where(first, tolerance**2 * size, enough)
        further = z + jnp.where(first, 0, size / before) * p
        steps, going = steps + 1, (size > enough) & (steps + 1 < most)
        return _Iteration(x + length * p, rhs, r, z, further, size, enough, residuals, preconditioned, steps, going)

    # From r = p = 0, the first turn makes r the right-hand side.
    zero, none, one = jnp.zeros_like(like), jnp.zeros((kept, n), dtype), jnp.ones((), dtype)
    start = _Iteration(zero, zero, zero, zero, zero, one, one, none, none, jnp.full((), -1), jnp.ones((), bool))
    end = jax.lax.while_loop(lambda state: state.going, step, start)
    failed = jnp.isnan(end.size) & (most > 0)
    return Solution(jnp.where(failed, jnp.nan, end.x), end.rhs, end.steps)
