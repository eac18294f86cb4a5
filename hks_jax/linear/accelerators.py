"""What is arranged otherwise where computations run on an accelerator.

There each launch of a kernel takes some 4 µs, however little it does, and where the host has to look at a number it
waits for everything launched before. Programs there have few kernels, and lengths known beforehand, at the price of
some arithmetic.
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
"""The compute capability (Ampere) from which on XLA compiles Triton's kernels."""


def at_hand() -> bool:
    """Return whether JAX's default device is an accelerator."""
    return jax.default_backend() != "cpu"


def kernels_compile() -> bool:
    """Return whether Pallas' kernels compile for the GPU here; False without one, as tracing them takes time."""
    if jax.default_backend() != "gpu":
        return False
    try:
        from jax.experimental.pallas import triton  # noqa: F401
    except ImportError:
        return False
    capability = str(getattr(jax.local_devices()[0], "compute_capability", ""))
    return capability.replace(".", "").isdigit() and float(capability) >= _CAPABILITY


INTERPRETED = False
"""Whether Pallas' kernels run on any device by XLA's operations instead: for tests."""

_PROVED: dict[tuple[str, str], bool] = {}


def kernels_agree(name: str, dtype: Any, compare: Callable[[], Iterable[tuple[Any, Any]]]) -> bool:
    """Return whether Pallas' kernels compile for the GPU here, and compute what they should, as the first use finds.

    ``compare`` runs each of them on a small problem, and returns its results beside those that are expected.

    Warns:
        RuntimeWarning: they do not; XLA's operations take their place for the rest of the process.
    """
    if not kernels_compile():
        return False
    key = name, np.dtype(dtype).name
    if key not in _PROVED:
        failure = ""
        try:
            with ThreadPoolExecutor(1) as pool:  # a thread of its own computes, also while this one traces a program
                results = pool.submit(lambda: [tuple(map(np.asarray, pair)) for pair in compare()]).result()
            for found, expected in results:
                error = np.max(np.abs(found - expected))
                if not error <= float(np.finfo(dtype).eps) ** 0.6 * np.max(np.abs(expected)):
                    failure = f"differ from what they should compute by {error:.1e}"
        except DeprecationWarning:  # JAX gives Triton up: where that is an error, no kernels are wanted
            _PROVED[key] = False
            return False
        except Exception as error:  # whatever the compiler of kernels raises
            failure = f"do not compile ({str(error).strip().splitlines()[0]})" if str(error) else "do not compile"
        if failure:
            device = jax.local_devices()[0]
            warnings.warn(
                f"on {device.device_kind} the kernels of {name} in {key[1]} {failure}; XLA's operations take their "
                "place, which are slower",
                RuntimeWarning,
                stacklevel=2,
            )
        _PROVED[key] = not failure
    return _PROVED[key]


def padded_size(n: int, least: int) -> int:
    """Return a power of two, as Triton's arrays need it, that is not below n, nor below the least, a power of two."""
    return max(least, 1 << (n - 1).bit_length())


def row_by_row(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return an array; on accelerators one that lies in memory in the order of its axes.

    Where a part of a large array is needed transposed, XLA would there rather transpose all of it.
    """
    return with_layout_constraint(x, Layout(major_to_minor=tuple(range(x.ndim)))) if at_hand() else x
