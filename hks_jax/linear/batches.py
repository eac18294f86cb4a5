"""Batches of problems: one after another where a device gains nothing from taking them together."""

import contextlib
from collections.abc import Callable, Hashable, Sequence
from functools import partial
from typing import Any

import jax

from hks_jax.traced import is_staged, is_traced


# Of a batch taken together, every loop runs until its last problem is done, both branches of a condition are computed,
# and the factorisations no longer fit into a CPU's cache: that took three times as long as one after another. One
# problem alone leaves most of an accelerator idle, though.
def one_by_one(function: Callable[..., Any], settings: tuple[Hashable, ...], *args: Any) -> Any:
    """Return function(*settings, *args), mapped over the problems of a batch one by one where `vmap` runs on a CPU.

    Not differentiable; derivative rules may call it.

    Args:
        function: traceable, the same object in every call, so that it is compiled once.
        settings: what is static.
        args: pytrees of arrays.
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
