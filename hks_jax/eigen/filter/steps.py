"""A round of filtering block by block, so that it can be told and interrupted while it is under way."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from hks_jax.eigen.filter.coarsening import GridLevel
from hks_jax.eigen.filter.rounds import Filtering, FilterState, Plan, filter_block, plan_round, ritz


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
        vectors = _filter_step(level, periodic, plan, chosen, state.values, jnp.asarray(number), vectors)
        jax.block_until_ready(vectors)
        done(int(degrees[: number + 1].sum()), int(degrees.sum()))
    return _finish_round(level, periodic, plan, vectors, chosen.terms, state.rounds + 1)


@partial(jax.jit, static_argnames=("periodic", "plan"), donate_argnames="vectors")
def _filter_step(
    level: GridLevel,
    periodic: tuple[bool, ...],
    plan: Plan,
    chosen: Filtering,
    values: Float[Array, " m"],
    number: Int[Array, ""],
    vectors: Float[Array, "m nodes"],
) -> Float[Array, "m nodes"]:
    return filter_block(level, periodic, plan, chosen, values, number, number, vectors)


@partial(jax.jit, static_argnames=("periodic", "plan"), donate_argnames="vectors")
def _finish_round(
    level: GridLevel,
    periodic: tuple[bool, ...],
    plan: Plan,
    vectors: Float[Array, "m nodes"],
    terms: Int[Array, ""],
    rounds: Int[Array, ""],
) -> FilterState:
    return ritz(level, periodic, plan, vectors, terms, rounds)
