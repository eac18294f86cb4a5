"""A round of filtering block by block, so that it can be told and interrupted while it is under way."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.eigen.filter.coarsening import GridLevel
from hks_jax.eigen.filter.rounds import FilterState, Plan, filter_block, plan_round, ritz


def improve_in_steps(
    level: GridLevel,
    periodic: tuple[bool, ...],
    plan: Plan,
    high: Float[Array, ""],
    rounding: Float[Array, ""],
    state: FilterState,
    done: Callable[[int, int], Any],
) -> FilterState:
    """Do what `improve` does on one device, block by block, and tell after each how many products are done of all."""
    chosen = plan_round(plan, level, high, rounding, state)
    degrees, vectors = np.asarray(chosen.degrees), state.vectors
    for number in np.flatnonzero(degrees):
        at = jnp.asarray(number)
        vectors = _filter_block(level, periodic, plan, chosen, state.values, at, at, vectors)
        jax.block_until_ready(vectors)
        done(int(degrees[: number + 1].sum()), int(degrees.sum()))
    return _ritz(level, periodic, plan, vectors, chosen.terms, state.rounds + 1)


_filter_block = jax.jit(filter_block, static_argnames=("periodic", "plan"), donate_argnames="vectors")
_ritz = jax.jit(ritz, static_argnames=("periodic", "plan"), donate_argnames="vectors")
