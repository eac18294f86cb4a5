"""Decisions that depend on whether computations run on an accelerator.

On an accelerator, each kernel launch takes at least about 4 µs. If the host reads a number, the host waits for all
earlier kernels. So programs for accelerators have few kernels and static loop lengths, but more arithmetic.
"""

import jax
from jax.experimental.layout import Layout, with_layout_constraint
from jaxtyping import Array, Float


def at_hand() -> bool:
    """Return whether JAX's default device is an accelerator."""
    return jax.default_backend() != "cpu"


def row_by_row(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return the array, on accelerators in row-major memory layout.

    Without this constraint, XLA transposes a whole array if it needs the transpose of a part.
    """
    return with_layout_constraint(x, Layout(major_to_minor=tuple(range(x.ndim)))) if at_hand() else x
