"""Whether values are there to be looked at, or stand for those of a computation to come."""

from typing import Any

import jax
import jax.numpy as jnp


def is_traced(tree: Any) -> bool:
    """Return whether any leaf is traced, as under `jax.jit`."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree))


def is_staged() -> bool:
    """Return whether all operations are part of a computation to come: nothing comes of one but a tracer."""
    return is_traced(jnp.zeros(()))
