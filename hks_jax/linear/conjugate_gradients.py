"""Preconditioned conjugate gradients, a block of columns at once, each with a matrix of its own."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

MAX_ITERATIONS = 200
_RESTARTS = 3


class _Iteration(NamedTuple):
    """The state of conjugate gradients for one block of columns."""

    x: Float[Array, "n_dof b"]
    r: Float[Array, "n_dof b"]
    p: Float[Array, "n_dof b"]
    first: Float[Array, " b"]
    energy: Float[Array, " b"]
    errors: Float[Array, " b"]
    going: Bool[Array, " b"]
    fresh: Bool[Array, ""]
    starts: Int[Array, ""]
    steps: Int[Array, ""]


def _dot(x: Float[Array, "n_dof b"], y: Float[Array, "n_dof b"]) -> Float[Array, " b"]:
    return jnp.sum(x * y, axis=0)


def conjugate_gradients(
    product: Callable[[Array], tuple[Array, Array]],
    precondition: Callable[[Array], Array],
    rhs: Float[Array, "n_dof b"],
    wanted: Float[Array, " b"],
    inner: Callable[[Array, Array], Array] = _dot,
    clean: Callable[[Array], Array] | None = None,
) -> Float[Array, "n_dof b"]:
    """Solve Aᵢxᵢ = rhsᵢ for a block of columns; NaN where the error asked for is not reached.

    Args:
        product: x ↦ Aᵢxᵢ, and for each column the energy xᵢᵀAᵢxᵢ below which Aᵢ counts as singular.
        precondition: r ↦ an approximation of Aᵢ⁻¹rᵢ.
        rhs: the right-hand sides.
        wanted: the error in the energy norm, relative; columns of which it is infinite stay zero.
        inner: the inner products (b,) of two blocks of columns, with respect to which all Aᵢ and the preconditioner are
            symmetric and positive definite; energies are measured with it.
        clean: x ↦ its part in the subspace in which all this is so. Where rounding has led out of it, which an energy
            that is not positive tells, the iteration starts again from there.
    """

    def going_on(state: _Iteration) -> Bool[Array, ""]:
        return jnp.any(state.going) & (state.steps < MAX_ITERATIONS)

    def restarted(x: Float[Array, "n_dof b"]) -> tuple[Float[Array, "n_dof b"], Float[Array, "n_dof b"]]:
        assert clean is not None
        x = clean(x)
        return x, rhs - product(x)[0]

    # The residual, preconditioned, tells the error before a step. That the step reduces it as the one before did saves
    # the preconditioner, which costs the most, once more than it takes steps.
    def step(state: _Iteration) -> _Iteration:
        x, r, p, first, before, errors, going, fresh, starts, steps = state
        z = precondition(r)
        energy = inner(r, z)
        first = jnp.where(steps == 0, energy, first)
        change = jnp.where(going & ~fresh, energy / before, 0)
        p = jnp.where(going, z + change * p, p)
        image, least = product(p)
        curvature = inner(p, image)
        regular = (curvature > least) & (energy > 0)
        length = jnp.where(going & regular, energy / jnp.where(regular, curvature, 1), 0)
        reduction = jnp.where(fresh, 1, jnp.sqrt(jnp.minimum(jnp.abs(change), 1)))
        error = jnp.where(regular, jnp.sqrt(jnp.abs(energy) / first) * reduction / wanted, jnp.inf)
        errors = jnp.where(going, error, errors)
        x, r = x + length * p, r - length * image
        again = jnp.asarray(False)
        if clean is not None:
            again = jnp.any(going & ~regular) & ~fresh & (starts < _RESTARTS)
            x, r = jax.lax.cond(again, lambda: restarted(x), lambda: (x, r))
        going = going & (regular | again) & (error > 1)
        return _Iteration(x, r, p, first, energy, errors, going, again, starts + again.astype(int), steps + 1)

    asked, none, zero = jnp.isfinite(wanted), jnp.ones_like(wanted), jnp.zeros((), int)
    errors = jnp.where(asked, jnp.inf, 0)
    start = _Iteration(jnp.zeros_like(rhs), rhs, rhs, none, none, errors, asked, jnp.asarray(True), zero, zero)
    end = jax.lax.while_loop(going_on, step, start)
    return jnp.where(end.errors <= 1, end.x, jnp.nan)
