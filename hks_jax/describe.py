"""Arrays in the one-line descriptions of what holds them."""

from typing import Any


def describe_array(value: Any) -> str:
    """Return dtype and shape of an array, traced or not, as in ``float64 (40, 40, 2, 2)``; of other leaves the repr."""
    dtype, shape = getattr(value, "dtype", None), getattr(value, "shape", None)
    return repr(value) if dtype is None or shape is None else f"{dtype} {tuple(shape)}"
