"""Preconditioned conjugate gradients, a block of rows at once, each with a matrix of its own."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

MAX_ITERATIONS = 200


class _Iteration(NamedTuple):
    """The state of conjugate gradients for one block of rows."""

    x: Float[Array, "b n_dof"]
    r: Float[Array, "b n_dof"]
    p: Float[Array, "b n_dof"]
    energy: Float[Array, " b"]
    errors: Float[Array, " b"]
    going: Bool[Array, " b"]
    steps: Int[Array, ""]


def conjugate_gradients(
    product: Callable[[Array], tuple[Array, Array]],
    precondition: Callable[[Array], Array],
    rhs: Float[Array, "b n_dof"],
    wanted: Float[Array, " b"],
) -> Float[Array, "b n_dof"]:
    """Solve Aᵢxᵢ = rhsᵢ for a block of rows; NaN where the error asked for is not reached.

    Args:
        product: x ↦ Aᵢxᵢ, and for each row the energy xᵢᵀAᵢxᵢ below which Aᵢ counts as singular.
        precondition: r ↦ an approximation of Aᵢ⁻¹rᵢ, symmetric and positive definite.
        rhs: the right-hand sides.
        wanted: the error in the energy norm, relative; rows of which it is infinite stay zero.
    """

    def going_on(state: _Iteration) -> Bool[Array, ""]:
        return jnp.any(state.going) & (state.steps < MAX_ITERATIONS)

    def step(state: _Iteration) -> _Iteration:
        x, r, p, energy, errors, going, steps = state
        image, least = product(p)
        curvature = jnp.sum(p * image, axis=1)
        regular = curvature > least
        length = jnp.where(going & regular, energy / jnp.where(regular, curvature, 1), 0)[:, None]
        x, r = x + length * p, r - length * image
        z = precondition(r)
        following = jnp.sum(r * z, axis=1)
        error = jnp.where(regular, jnp.sqrt(jnp.abs(following) / first) / wanted, jnp.inf)
        errors = jnp.where(going, error, errors)
        p = z + jnp.where(going, following / jnp.where(going, energy, 1), 0)[:, None] * p
        return _Iteration(x, r, p, following, errors, going & regular & (error > 1), steps + 1)

    z = precondition(rhs)
    first = jnp.sum(rhs * z, axis=1)
    asked = jnp.isfinite(wanted)
    start = _Iteration(jnp.zeros_like(rhs), rhs, z, first, jnp.where(asked, jnp.inf, 0), asked, jnp.zeros((), int))
    end = jax.lax.while_loop(going_on, step, start)
    return jnp.where((end.errors <= 1)[:, None], end.x, jnp.nan)
