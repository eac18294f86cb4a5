"""Decisions that depend on whether computations run on an accelerator.

On an accelerator, each kernel launch takes at least about 4 µs. If the host reads a number, the host waits for all
earlier kernels. So programs for accelerators have few kernels and static loop lengths, but more arithmetic.
"""

import warnings
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import numpy as np
from jax.experimental.layout import Layout, with_layout_constraint
from jaxtyping import Array, Float

_CAPABILITY = 8.0
"""The least compute capability (Ampere) for which XLA compiles Triton kernels."""


def at_hand() -> bool:
    """Return whether JAX's default device is an accelerator."""
    return jax.default_backend() != "cpu"


def kernels_compile() -> bool:
    """Return whether Pallas kernels compile for this machine's GPU; False if there is no GPU."""
    if jax.default_backend() != "gpu":
        return False
    try:
        from jax.experimental.pallas import triton  # noqa: F401
    except ImportError:
        return False
    capability = str(getattr(jax.local_devices()[0], "compute_capability", ""))
    return capability.replace(".", "").isdigit() and float(capability) >= _CAPABILITY


INTERPRETED = False
"""Whether Pallas interprets kernels by XLA operations, which any device supports; for tests."""

_PROVED: dict[tuple[str, str], bool] = {}


def kernels_agree(name: str, dtype: Any, compare: Callable[[], Iterable[tuple[Any, Any]]]) -> bool:
    """Return whether Pallas kernels compile for this machine's GPU and are correct; tested at the first use.

    ``compare`` runs each kernel on a small problem, and returns pairs of computed and expected results.

    Warns:
        RuntimeWarning: the kernels fail the test; XLA operations replace them for the rest of the process.
    """
    if not kernels_compile():
        return False
    key = name, np.dtype(dtype).name
    if key not in _PROVED:
        try:
            with ThreadPoolExecutor(1) as pool:  # a separate thread can compute while this thread traces
                results = pool.submit(lambda: [tuple(map(np.asarray, pair)) for pair in compare()]).result()
            error = np.max([np.max(np.abs(found - right)) / np.max(np.abs(right)) for found, right in results])
            failure = "" if error <= float(np.finfo(dtype).eps) ** 0.6 else f"have a relative error of {error:.1e}"
        except DeprecationWarning:  # JAX deprecates Triton; if warnings are errors, use no kernels
            _PROVED[key] = False
            return False
        except Exception as reason:  # the kernel compiler may raise any error
            failure = f"do not compile ({(str(reason).strip() or type(reason).__name__).splitlines()[0]})"
        if failure:
            device = jax.local_devices()[0].device_kind
            message = f"on {device} the kernels of {name} in {key[1]} {failure}; slower XLA operations replace them"
            warnings.warn(message, RuntimeWarning, stacklevel=2)
        _PROVED[key] = not failure
    return _PROVED[key]


def padded_size(n: int, least: int) -> int:
    """Return the smallest power of two that is at least n and at least ``least``, as Triton requires of array sizes."""
    return max(least, 1 << (n - 1).bit_length())


def row_by_row(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return the array, on accelerators in row-major memory layout.

    Without this constraint, XLA transposes a whole array if it needs the transpose of a part.
    """
    return with_layout_constraint(x, Layout(major_to_minor=tuple(range(x.ndim)))) if at_hand() else x
