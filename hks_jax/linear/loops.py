"""Loops that run in Python for concrete values, where they can be interrupted, and in XLA for traced values.

On CPUs, a batch of problems is also solved in a loop, because solving the problems together is not faster.
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
    """Apply steps to a state while a condition holds; by `jax.lax.while_loop` if the state is traced."""
    if is_traced(state):
        return jax.lax.while_loop(going_on, step, state)
    while going_on(state):
        state = step(state)
    return state


def for_each(count: int, step: Callable[[Any, State], State], state: State) -> State:
    """Apply ``step(i, state)`` for i = 0, …, count − 1; by `jax.lax.fori_loop` if the state is traced."""
    if is_traced(state):
        return jax.lax.fori_loop(0, count, step, state)
    for number in range(count):
        state = step(jnp.asarray(number), state)
    return state


def by_column_ranges(function: Callable[[jax.Array], jax.Array], width: int, x: jax.Array) -> jax.Array:
    """Replace ranges of at most ``width`` columns of x by their images under a function, in place under `jax.jit`."""

    def replace(start: Any, size: int, x: jax.Array) -> jax.Array:
        image = function(jax.lax.dynamic_slice_in_dim(x, start, size, axis=1))
        return jax.lax.dynamic_update_slice_in_dim(x, image, start, axis=1)

    whole, rest = divmod(x.shape[1], width)
    if whole:
        x = jax.lax.fori_loop(0, whole, lambda number, x: replace(number * width, width, x), x)
    return replace(whole * width, rest, x) if rest else x


def when(condition: Any, function: Callable[[State], State], state: State) -> State:
    """Return ``function(state)`` if the condition holds, otherwise the state; by `jax.lax.cond` if it is traced."""
    if is_traced(condition):
        return jax.lax.cond(condition, function, lambda state: state, state)
    return function(state) if condition else state


# In a vectorised batch, every loop runs until its last problem has finished, both branches of conditions are computed,
# and the factorisations exceed a CPU's cache. In measurements, a batch took three times as long as the problems in
# sequence. On an accelerator, however, a single problem leaves most of the device idle.
def one_by_one(function: Callable[..., Any], settings: tuple[Hashable, ...], *args: Any) -> Any:
    """Return function(*settings, *args). Under `vmap` on a CPU, the problems of a batch run in sequence.

    The result is not differentiable, but derivative rules may call `one_by_one`. ``function`` must be traceable, and
    the same object in every call, so that it is compiled once. Settings are static.
    """
    if not is_traced(args):
        # Without `eval_context`, a derivative outside `jit` would compile the undifferentiated function again.
        with contextlib.nullcontext() if is_staged() else jax.core.eval_context():
            return function(*settings, *args)
    # `custom_vmap` supports no static arguments, so that each call defines a rule; its body is compiled only once.
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
    """Return the results of a batch. Leaves that are not ``batched`` are common to all problems."""

    def problem(call: Callable[..., Any], own: list[jax.Array]) -> Any:
        remaining = iter(own)
        whole = [next(remaining) if of_batch else leaf for of_batch, leaf in zip(batched, leaves, strict=True)]
        return call(*jax.tree.unflatten(structure, whole))

    # The problems of nested batches run in sequence, like those of a single batch.
    alone = partial(problem, partial(one_by_one, function, settings))
    together = jax.vmap(partial(problem, partial(function, *settings)))
    own = [leaf for of_batch, leaf in zip(batched, leaves, strict=True) if of_batch]
    return jax.lax.platform_dependent(own, cpu=partial(jax.lax.map, alone), default=together)
