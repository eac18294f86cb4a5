"""Tests whether values are concrete or traced."""

from typing import Any

import jax


def is_traced(tree: Any) -> bool:
    """Return whether any leaf is traced, as under `jax.jit`."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree))
