"""Tests whether values are concrete or traced."""

from typing import Any

import jax
import numpy as np

_CONSTANT = np.zeros((), np.float32)


def is_traced(tree: Any) -> bool:
    """Return whether any leaf is traced, as under `jax.jit`."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree))


def is_staged() -> bool:
    """Return whether JAX stages every operation, as under `jax.jit`, so that even constants give tracers."""
    return is_traced(jax.lax.stop_gradient(_CONSTANT))  # this operation computes nothing unless it is staged
