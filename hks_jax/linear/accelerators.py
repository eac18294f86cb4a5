"""What is arranged otherwise where computations run on an accelerator.

There each launch of a kernel takes some 4 µs, however little it does, and where the host has to look at a number it
waits for everything launched before. Programs there have few kernels, and lengths known beforehand, at the price of
some arithmetic.
"""

import jax
from jax.experimental.layout import Layout, with_layout_constraint
from jaxtyping import Array, Float

_CAPABILITY = 8.0
"""The compute capability (Ampere) from which on XLA compiles Triton's kernels."""


def at_hand() -> bool:
    """Return whether JAX's default device is an accelerator."""
    return jax.default_backend() != "cpu"


def kernels_compile() -> bool:
    """Return whether Pallas' kernels compile for the GPU here; False without one, as tracing them takes time.

    Whether it is a CUDA device is decided where kernels are used.
    """
    if jax.default_backend() != "gpu":
        return False
    try:
        from jax.experimental.pallas import triton  # noqa: F401
    except ImportError:
        return False
    capability = str(getattr(jax.local_devices()[0], "compute_capability", ""))
    return capability.replace(".", "").isdigit() and float(capability) >= _CAPABILITY


def padded_size(n: int, least: int) -> int:
    """Return a power of two, as Triton's arrays need it, that is not below n, nor below the least, a power of two."""
    return max(least, 1 << (n - 1).bit_length())


def row_by_row(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return an array; on accelerators one that lies in memory in the order of its axes.

    Where a part of a large array is needed transposed, XLA would there rather transpose all of it.
    """
    return with_layout_constraint(x, Layout(major_to_minor=tuple(range(x.ndim)))) if at_hand() else x
