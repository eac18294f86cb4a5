"""Tests for tracers, which stand for the values of a computation in JAX transformations."""

from typing import Any

import jax
import jax.numpy as jnp


def is_traced(tree: Any) -> bool:
    """Return whether any leaf is a tracer, as under `jax.jit`."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree))


def is_staged() -> bool:
    """Return whether every operation returns a tracer, as under `jax.jit`, even if its arguments are constants."""
    return is_traced(jnp.zeros(()))
