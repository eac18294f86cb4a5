"""Loops that are written once: Python's where values are concrete, and can then be interrupted; XLA's where traced."""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

from hks_jax.traced import is_traced

State = TypeVar("State")


def while_loop(going_on: Callable[[State], Any], step: Callable[[State], State], state: State) -> State:
    """Return what the steps make of a state; `jax.lax.while_loop` where any of it is traced."""
    if is_traced(state):
        return jax.lax.while_loop(going_on, step, state)
    while going_on(state):
        state = step(state)
    return state


def for_each(count: int, step: Callable[[Any, State], State], state: State) -> State:
    """Return what steps, given their numbers, make of a state; `jax.lax.fori_loop` where any of it is traced."""
    if is_traced(state):
        return jax.lax.fori_loop(0, count, step, state)
    for number in range(count):
        state = step(jnp.asarray(number), state)
    return state


def when(condition: Any, function: Callable[[State], State], state: State) -> State:
    """Return ``function(state)`` if the condition holds, and else the state; `jax.lax.cond` where it is traced."""
    if is_traced(condition):
        return jax.lax.cond(condition, function, lambda state: state, state)
    return function(state) if condition else state
