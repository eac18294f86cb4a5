"""Preconditioned conjugate gradients for K − λᵢM on the complement of known eigenvectors, a block of rows at once."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from hks_jax.eigen.complement import MAX_ITERATIONS, SINGULAR
from hks_jax.fem.pencil import Pencil


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
    pencil: Pencil,
    precondition: Callable[[Array], Array],
    shifts: Float[Array, " b"],
    rhs: Float[Array, "b n_dof"],
    wanted: Float[Array, " b"],
    beyond: Float[Array, ""],
) -> Float[Array, "b n_dof"]:
    """Solve (K − λᵢM) xᵢ = rhsᵢ for a block of rows; NaN where the error asked for is not reached.

    ``wanted`` is the error in the energy norm, relative; rows of which it is infinite stay zero.
    """

    def going_on(state: _Iteration) -> Bool[Array, ""]:
        return jnp.any(state.going) & (state.steps < MAX_ITERATIONS)

    def step(state: _Iteration) -> _Iteration:
        x, r, p, energy, errors, going, steps = state
        image = pencil.mass.apply(p)
        product = pencil.stiffness.apply(p) - shifts[:, None] * image
        curvature = jnp.sum(p * product, axis=1)
        # Where it nearly vanishes, an eigenvalue equal to λᵢ is left on the complement: there is no solution.
        regular = curvature > SINGULAR * beyond * jnp.sum(p * image, axis=1)
        length = jnp.where(going & regular, energy / jnp.where(regular, curvature, 1), 0)[:, None]
        x, r = x + length * p, r - length * product
        z = precondition(r)
        following = jnp.sum(r * z, axis=1)
        error = jnp.where(regular, jnp.sqrt(jnp.abs(following) / first) / wanted, jnp.inf)
        errors = jnp.where(going, error, errors)
        p = z + (following / jnp.where(going, energy, 1))[:, None] * p
        return _Iteration(x, r, p, following, errors, going & regular & (error > 1), steps + 1)

    z = precondition(rhs)
    first = jnp.sum(rhs * z, axis=1)
    asked = jnp.isfinite(wanted)
    start = _Iteration(jnp.zeros_like(rhs), rhs, z, first, jnp.where(asked, jnp.inf, 0), asked, jnp.zeros((), int))
    end = jax.lax.while_loop(going_on, step, start)
    return jnp.where((end.errors <= 1)[:, None], end.x, jnp.nan)


def first_beyond(values: Float[Array, " p"]) -> Float[Array, ""]:
    """Return an estimate Λ of the first eigenvalue that is left."""
    return jnp.where(values[-1] > 0, values[-1] * (1 + 1 / values.size), 1)
