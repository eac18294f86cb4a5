"""Preconditioned conjugate gradients in JAX or NumPy, for a block of columns, each with its own matrix."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from hks_jax.compilation import library_of
from hks_jax.linear.loops import when, while_loop
from hks_jax.linear.products import matmul, products_with_columns

Array = Any
"""An array of NumPy or JAX; all arguments and the result are of the same library."""

_MOST_STEPS = 200
_RESTARTS = 3
_KEPT, _MEMORY = 400, 4e8
"""The maximal number of residuals for reorthogonalisation, and their maximal memory in bytes."""


class Solution(NamedTuple):
    """The state of conjugate gradients for one block of columns. For finished columns, r and p are zero."""

    x: Float[Array, "n b"]  # the approximate solutions; at the end, NaN for columns in which NaN occurred
    rhs: Float[Array, "n b"]  # the right-hand sides
    r: Float[Array, "n b"]  # the residuals
    z: Float[Array, "n b"]  # the preconditioned residuals
    p: Float[Array, "n b"]  # the next search directions
    first: Float[Array, " b"]  # the inner products rᵀz at the first step
    energy: Float[Array, " b"]  # the inner products rᵀz at the current step
    change: Float[Array, " b"]  # the inner products rᵀz divided by those at the previous step
    errors: Float[Array, " b"]  # estimated relative errors divided by the wanted errors; at most 1 if converged
    going: Bool[Array, " b"]  # whether the iteration of each column goes on
    fresh: Bool[Array, ""]  # whether the next step is the first, or the first after a restart
    starts: Int[Array, ""]  # the number of restarts
    steps: Int[Array, ""]  # the number of steps; −1 if the next product is the right-hand side
    # the residuals r and preconditioned residuals z of all steps, divided by √(rᵀz); None without reorthogonalisation
    kept: tuple[Float[Array, "m n"], Float[Array, "m n"]] | None

    @property
    def converged(self) -> Float[Array, "n b"]:
        """The solutions; NaN for columns that did not converge."""
        xp = library_of(self.x)
        return xp.where(self.errors <= 1, self.x, xp.nan)


def conjugate_gradients(
    # maps columns xᵢ to the products Aᵢxᵢ, and to values of xᵢᵀAᵢxᵢ at or below which Aᵢ counts as singular
    product: Callable[..., tuple[Array, Array]],
    precondition: Callable[[Array], Array],  # maps residuals rᵢ to approximations of Aᵢ⁻¹rᵢ
    rhs: Float[Array, "n b"],
    wanted: Float[Array, " b"],  # the wanted relative error in the energy norm; if infinite, the column stays zero
    clean: Callable[[Array], Array] | None = None,
    most: Int[Array, ""] | int = _MOST_STEPS,  # the maximal number of steps
    orthogonal: bool = False,
) -> Solution:
    """Solve Aᵢxᵢ = rhsᵢ for a block of columns. All Aᵢ and the preconditioner are symmetric and positive definite.

    Args:
        clean: the projection onto the subspace in which all Aᵢ are positive definite. If rounding makes an inner
            product rᵢᵀzᵢ or pᵢᵀAᵢpᵢ nonpositive, the iteration restarts from the projected solutions.
        orthogonal: whether to reorthogonalise residuals, which reduces the number of steps for ill-conditioned
            matrices. Reorthogonalisation requires JAX arrays with b = 1. If ``orthogonal`` and ``first`` are true,
            ``product(x, first)`` must return the right-hand side, which may share compiled operations with products.
    """
    xp, n = library_of(rhs), len(rhs)

    def restarted(both: tuple[Array, Array]) -> tuple[Array, Array]:
        assert clean is not None
        x = clean(both[0])
        return x, rhs - product(x)[0]

    def relative(energy: Array, first: Array) -> Array:
        return xp.sqrt(xp.abs(energy) / xp.where(first > 0, first, 1)) / wanted

    def direct(state: Solution) -> Solution:
        z = precondition(state.r)
        energy, begin = (state.r * z).sum(axis=0), state.steps == 0
        change = xp.where(state.going & ~state.fresh, energy / state.energy, 0)
        p = xp.where(state.going, z + change[(None,) * (z.ndim - change.ndim)] * state.p, 0)
        z = z if orthogonal else state.z
        return state._replace(z=z, p=p, first=xp.where(begin, energy, state.first), energy=energy, change=change)

    def advance(state: Solution) -> tuple[Solution, Bool[Array, " b"]]:
        p, begin = state.p, state.steps < 0
        image, least = product(p, begin) if orthogonal else product(p)
        curvature = (p * image).sum(axis=0)
        regular = ~((curvature <= least) | (state.energy <= 0)) | begin
        length = xp.where(state.going & regular, state.energy / xp.where(regular & ~begin, curvature, 1), 0)
        length = xp.where(begin, -1, length)
        wide = length[(None,) * (p.ndim - length.ndim)]
        x, r, again = state.x + wide * p, state.r - wide * image, begin
        kept = state.kept
        if kept is not None:
            # In exact arithmetic, residuals of different steps satisfy rᵢᵀPrⱼ = 0, where P is the preconditioner.
            # Rounding destroys this orthogonality once an extreme Ritz pair has converged, and the iteration finds this
            # pair again (Paige 1971; Simon 1984). If eigenvalues decay over eight decades, the repetitions double the
            # number of steps. Reorthogonalisation takes less time than additional steps if products with the matrix are
            # expensive and n is small. If the memory for residuals is full, each new residual overwrites the last row.
            # The first residuals stay, because they prevent repetitions of the first converged pairs.
            at, root = jnp.clip(state.steps, 0, len(kept[0]) - 1), jnp.sqrt(state.energy)
            kept = kept[0].at[at].set(state.r[:, 0] / root), kept[1].at[at].set(state.z[:, 0] / root)
            r = r - matmul(kept[0].T, products_with_columns(kept[1], r))
        if clean is not None:
            again = xp.any(state.going & ~regular) & ~state.fresh & (state.starts < _RESTARTS)
            x, r = when(again, restarted, (x, r))
        rhs = xp.where(begin, image, state.rhs) if orthogonal else state.rhs
        starts = state.starts + xp.where(again, 1, 0)
        return state._replace(x=x, r=r, rhs=rhs, fresh=again, starts=starts, steps=state.steps + 1, kept=kept), regular

    def step(before: Solution) -> Solution:
        if orthogonal:
            state, regular = advance(before)
            state = direct(state)
            error = relative(state.energy, state.first)
        else:
            before = direct(before)
            state, regular = advance(before)
            # The preconditioned residual gives the error before this step. The step is assumed to reduce the error by
            # the same factor as the previous step; this saves one expensive application of the preconditioner.
            skipped = before.fresh | ~regular
            reduction = xp.where(skipped, 1, xp.sqrt(xp.minimum(xp.abs(before.change), 1)))
            error = relative(before.energy, before.first) * reduction
        # If symmetry exhausts the Krylov space, the residual is pure rounding, and rᵀz may be negative. The iteration
        # then stops, like that of a singular matrix, but |rᵀz| shows that the solution is accurate.
        errors = xp.where(before.going, error, before.errors)
        going = before.going & (regular | state.fresh) & (errors > 1)
        # On the host, the preconditioner skips zero columns.
        return state._replace(r=xp.where(going, state.r, 0), p=xp.where(going, state.p, 0), errors=errors, going=going)

    asked, one, zero = xp.isfinite(wanted), xp.ones_like(wanted), xp.zeros_like(rhs)
    room = max(min(n, _KEPT, int(_MEMORY / (2 * n * rhs.dtype.itemsize))), 1)
    start = Solution(
        x=zero,
        rhs=rhs,
        r=zero if orthogonal else xp.where(asked, rhs, 0),
        z=zero,
        p=zero,
        first=one,
        energy=one,
        change=one,
        errors=xp.where(asked, xp.inf, 0),
        going=asked,
        fresh=xp.asarray(True),
        starts=xp.asarray(0),
        steps=xp.asarray(-1 if orthogonal else 0),
        kept=(jnp.zeros((room, n), rhs.dtype),) * 2 if orthogonal else None,
    )
    end = while_loop(lambda state: xp.any(state.going) & (state.steps < most), step, start)
    failed = xp.isnan(end.errors) & (most > 0)
    return end._replace(x=xp.where(failed, xp.nan, end.x))
