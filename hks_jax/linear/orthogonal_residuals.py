"""Conjugate gradients for one ill-conditioned matrix, with residuals that stay orthogonal in spite of rounding."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

_MOST, _MEMORY = 400, 4e8
"""Residuals that are kept at most, and bytes that they may take."""


class _Iteration(NamedTuple):
    """The state after some steps.

    Attributes:
        x: the solution so far.
        r: its residual.
        z: Pr.
        p: the next direction.
        size: rᵀPr.
        residuals: the residuals of all steps, divided by √(rᵀPr); zero where there is none yet.
        preconditioned: P times them.
        steps: how many.
        going: whether there is a next one.
    """

    x: Float[Array, " n"]
    r: Float[Array, " n"]
    z: Float[Array, " n"]
    p: Float[Array, " n"]
    size: Float[Array, ""]
    residuals: Float[Array, "m n"]
    preconditioned: Float[Array, "m n"]
    steps: Int[Array, ""]
    going: Bool[Array, ""]


# In exact arithmetic rᵢᵀPrⱼ = 0. Rounding loses that as soon as an eigenvector at the end of the spectrum is known, and
# conjugate gradients then look for it again and again: where eigenvalues fall off over eight decades, that doubles the
# number of steps. The products with A being dear and n small, it is cheaper to restore it (Paige 1971; Simon 1984).
def orthogonal_conjugate_gradients(
    product: Callable[[Float[Array, " n"]], Float[Array, " n"]],
    precondition: Callable[[Float[Array, " n"]], Float[Array, " n"]],
    rhs: Float[Array, " n"],
    tolerance: Float[Array, ""],
    most: Int[Array, ""],
) -> tuple[Float[Array, " n"], Int[Array, ""]]:
    """Solve Ax = rhs until the residual r = rhs − Ax has √(rᵀPr) below a tolerance, or for so many steps.

    Where P resembles A⁻¹ up to a factor, that norm of the residual is the energy norm √(eᵀAe) of the error, relative to
    that of x. Each step takes one product with A.

    Args:
        product: x ↦ Ax, A symmetric and positive definite.
        precondition: r ↦ Pr, an approximation of A⁻¹r up to a factor, symmetric and positive definite.
        rhs: the right-hand side.
        tolerance: relative to √(bᵀPb), b the right-hand side.
        most: steps after which to stop all the same.

    Returns:
        x, and the number of steps. x is NaN where a product is.
    """
    (n,), dtype = rhs.shape, rhs.dtype
    kept = max(min(n, _MOST, int(_MEMORY / (2 * n * dtype.itemsize))), 1)
    z = precondition(rhs)
    size = jnp.vdot(rhs, z)
    enough = tolerance**2 * size

    def step(state: _Iteration) -> _Iteration:
        x, r, z, p, before, residuals, preconditioned, steps, _ = state
        image = product(p)
        length = before / jnp.vdot(p, image)
        # When all places are taken the last one is used again: what is lost first was known first.
        at, root = jnp.minimum(steps, kept - 1), jnp.sqrt(before)
        residuals, preconditioned = residuals.at[at].set(r / root), preconditioned.at[at].set(z / root)
        r = r - length * image
        r = r - jnp.matmul(jnp.matmul(preconditioned, r, precision="highest"), residuals, precision="highest")
        z = precondition(r)
        size = jnp.vdot(r, z)
        going = (size > enough) & (steps + 1 < most)
        p_next = z + size / before * p
        return _Iteration(x + length * p, r, z, p_next, size, residuals, preconditioned, steps + 1, going)

    none = jnp.zeros((kept, n), dtype)
    start = _Iteration(jnp.zeros_like(rhs), rhs, z, z, size, none, none, jnp.zeros((), int), ~(size <= 0))
    end = jax.lax.while_loop(lambda state: state.going, step, start)
    return end.x, end.steps
