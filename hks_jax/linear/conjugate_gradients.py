"""Preconditioned conjugate gradients, a block of columns at once, each with a matrix of its own; in JAX or NumPy."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from hks_jax.linear.loops import when, while_loop
from hks_jax.linear.products import matmul, products_with_columns

Array = Any
"""NumPy's or JAX's, the same for all arguments and the result."""

_MOST_STEPS = 200
_RESTARTS = 3
_KEPT, _MEMORY = 400, 4e8
"""Residuals that are kept orthogonal at most, and bytes that they may take."""


class Solution(NamedTuple):
    """The state of conjugate gradients for one block of columns; r and p are zero for those that are done."""

    x: Float[Array, "n b"]  # the solutions so far; at the end NaN where a product is
    rhs: Float[Array, "n b"]  # the right-hand sides
    r: Float[Array, "n b"]  # their residuals
    z: Float[Array, "n b"]  # these, preconditioned
    p: Float[Array, "n b"]  # the next directions
    first: Float[Array, " b"]  # rᵀz at the beginning,
    energy: Float[Array, " b"]  # and now
    change: Float[Array, " b"]  # the energy relative to that before
    errors: Float[Array, " b"]  # estimates, relative, in units of those wanted; above 1 an iteration did not converge
    going: Bool[Array, " b"]  # which columns go on
    fresh: Bool[Array, ""]  # whether the next step is the first, or the first after a restart
    starts: Int[Array, ""]  # how many restarts there were
    steps: Int[Array, ""]  # how many steps; −1 before the right-hand side is known
    # the residuals of all steps, divided by √(rᵀz), and z likewise; None where none are kept
    kept: tuple[Float[Array, "m n"], Float[Array, "m n"]] | None

    @property
    def converged(self) -> Float[Array, "n b"]:
        """The solutions; NaN where the error asked for is not reached."""
        xp = self.x.__array_namespace__()
        return xp.where(self.errors <= 1, self.x, xp.nan)


def _dot(x: Float[Array, "n b"], y: Float[Array, "n b"]) -> Float[Array, " b"]:
    return (x * y).sum(axis=0)


def conjugate_gradients(
    product: Callable[..., tuple[Array, Array]],  # x ↦ Aᵢxᵢ, and the energies below which Aᵢ counts as singular
    precondition: Callable[[Array], Array],  # r ↦ an approximation of Aᵢ⁻¹rᵢ
    rhs: Float[Array, "n b"],
    wanted: Float[Array, " b"],  # the error in the energy norm, relative; columns of which it is infinite stay zero
    inner: Callable[[Array, Array], Array] = _dot,
    clean: Callable[[Array], Array] | None = None,
    most: Int[Array, ""] | int = _MOST_STEPS,  # steps after which to stop all the same
    orthogonal: bool = False,
) -> Solution:
    """Solve Aᵢxᵢ = rhsᵢ for a block of columns.

    Args:
        inner: the inner products (b,) of two blocks of columns, with respect to which all Aᵢ and the preconditioner are
            symmetric and positive definite; energies are measured with it.
        clean: x ↦ its part in the subspace in which all this is so. Where rounding has led out of it, which an energy
            that is not positive tells, the iteration starts again from there.
        orthogonal: for one ill-conditioned matrix whose products are dear; b = 1, in JAX. Residuals stay orthogonal in
            spite of rounding. ``product(x, first)`` then returns the right-hand side where ``first``, so that what it
            has in common with Ax is compiled once, and of ``rhs`` the shape counts.
    """
    xp, n = rhs.__array_namespace__(), len(rhs)

    def restarted(both: tuple[Array, Array]) -> tuple[Array, Array]:
        assert clean is not None
        x = clean(both[0])
        return x, rhs - product(x)[0]

    def relative(energy: Array, first: Array) -> Array:
        return xp.sqrt(xp.abs(energy) / xp.where(first > 0, first, 1)) / wanted

    def direct(state: Solution) -> Solution:
        z = precondition(state.r)
        energy, begin = inner(state.r, z), state.steps == 0
        change = xp.where(state.going & ~state.fresh, energy / state.energy, 0)
        p = xp.where(state.going, z + change[(None,) * (z.ndim - change.ndim)] * state.p, 0)
        z = z if orthogonal else state.z
        return state._replace(z=z, p=p, first=xp.where(begin, energy, state.first), energy=energy, change=change)

    def advance(state: Solution) -> tuple[Solution, Bool[Array, " b"]]:
        p, begin = state.p, state.steps < 0
        image, least = product(p, begin) if orthogonal else product(p)
        curvature = inner(p, image)
        regular = ~((curvature <= least) | (state.energy <= 0)) | begin
        length = xp.where(state.going & regular, state.energy / xp.where(regular & ~begin, curvature, 1), 0)
        length = xp.where(begin, -1, length)
        wide = length[(None,) * (p.ndim - length.ndim)]
        x, r, again = state.x + wide * p, state.r - wide * image, begin
        kept = state.kept
        if kept is not None:
            # In exact arithmetic rᵢᵀPrⱼ = 0. Rounding loses that as soon as an eigenvector at the end of the spectrum
            # is known, and conjugate gradients then look for it again and again: where eigenvalues fall off over eight
            # decades, that doubles the number of steps. Where products are dear and n is small it is cheaper to
            # restore it (Paige 1971; Simon 1984). When all places are taken the last one is used again: what is lost
            # first was known first.
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
            # The residual, preconditioned, tells the error before a step. That the step reduces it as the one before
            # did saves the preconditioner, which costs the most, once more than it takes steps.
            reduction = xp.where(before.fresh, 1, xp.sqrt(xp.minimum(xp.abs(before.change), 1)))
            error = relative(before.energy, before.first) * reduction
        errors = xp.where(before.going, xp.where(regular, error, xp.inf), before.errors)
        going = before.going & (regular | state.fresh) & (errors > 1)
        # The host takes no products of columns that are zero.
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
