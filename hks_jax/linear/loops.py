"""Loops that are written once: Python's where values are concrete, and can then be interrupted; XLA's where traced.

Batches of problems are loops, too: one after another where a device gains nothing from taking them together.
"""

import contextlib
from collections.abc import Callable, Hashable, Sequence
from functools import partial
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

from hks_jax.traced import is_staged, is_traced

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


# Of a batch taken together, every loop runs until its last problem is done, both branches of a condition are computed,
# and the factorisations no longer fit into a CPU's cache: that took three times as long as one after another. One
# problem alone leaves most of an accelerator idle, though.
def one_by_one(function: Callable[..., Any], settings: tuple[Hashable, ...], *args: Any) -> Any:
    """Return function(*settings, *args), mapped over the problems of a batch one by one where `vmap` runs on a CPU.

    Not differentiable; derivative rules may call it. The function is traceable and the same object in every call, so
    that it is compiled once; settings are static.
    """
    if not is_traced(args):
        # Of a derivative taken plainly, JAX would compile the known part anew.
        with contextlib.nullcontext() if is_staged() else jax.core.eval_context():
            return function(*settings, *args)
    # `custom_vmap` takes no static arguments, and so each call has a rule of its own; what it runs is compiled once.
    problem = jax.custom_batching.custom_vmap(partial(function, *settings))

    @problem.def_vmap
    def batch(size: int, batched: Sequence[Any], *args: Any) -> tuple[Any, Any]:
        leaves, structure = jax.tree.flatten(args)
        result = _batch(function, settings, structure, tuple(jax.tree.leaves(batched)), *leaves)
        return result, jax.tree.map(lambda _: True, result)

    return problem(*args)


@partial(jax.jit, static_argnums=(0, 1, 2, 3))
def _batch(
    function: Callable[..., Any],
    settings: tuple[Hashable, ...],
    structure: jax.tree_util.PyTreeDef,
    batched: tuple[bool, ...],
    *leaves: jax.Array,
) -> Any:
    """Return the results for a batch, of whose leaves some are the same for all problems."""

    def problem(call: Callable[..., Any], own: list[jax.Array]) -> Any:
        remaining = iter(own)
        whole = [next(remaining) if of_batch else leaf for of_batch, leaf in zip(batched, leaves, strict=True)]
        return call(*jax.tree.unflatten(structure, whole))

    # A batch of batches comes one by one, too.
    alone = partial(problem, partial(one_by_one, function, settings))
    together = jax.vmap(partial(problem, partial(function, *settings)))
    own = [leaf for of_batch, leaf in zip(batched, leaves, strict=True) if of_batch]
    return jax.lax.platform_dependent(own, cpu=partial(jax.lax.map, alone), default=together)
