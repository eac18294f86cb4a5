"""Tests whether values are concrete or traced."""

from typing import Any

import jax
import jax.numpy as jnp


def is_traced(tree: Any) -> bool:
    """Return whether any leaf is traced, as under `jax.jit`."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree))


def is_staged() -> bool:
    """Return whether JAX stages every operation, as under `jax.jit`, so that even constants give tracers."""
    return is_traced(jnp.zeros(()))
