"""Static arrays, descriptions of arrays, and arrays with undefined entries."""

import hashlib
from collections.abc import Callable
from functools import cached_property, wraps
from typing import Any, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hks_jax.traced import is_staged

Scalar = Float[Array, ""]

P = ParamSpec("P")
R = TypeVar("R")


class ByKey:
    """A base class of objects that are compared and hashed by a key, so that they can be static under `jax.jit`."""

    _key: Any

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, type(self)) and self._key == other._key)

    def __hash__(self) -> int:
        return hash(self._key)


class StaticArray(ByKey):
    """A read-only NumPy array that is static under `jax.jit`."""

    def __init__(self, value: Any, dtype: Any = None) -> None:
        array = np.array(value, dtype=dtype, order="C")
        array.setflags(write=False)
        self.value = array

    @cached_property
    def _key(self) -> bytes:
        header = f"{self.value.dtype.str}{self.value.shape}".encode()
        return hashlib.blake2b(self.value.tobytes(), digest_size=16, key=header[:64]).digest()

    def __repr__(self) -> str:
        return f"StaticArray({self.value.dtype}{list(self.value.shape)})"


def jax_array(value: Any) -> Array:
    """Return a JAX array like `jnp.asarray`, but without compiling a program for each shape of NumPy arrays."""
    return jax.device_put(value) if isinstance(value, np.ndarray) and not is_staged() else jnp.asarray(value)


def describe_array(value: Any) -> str:
    """Return the dtype and shape of an array, such as ``float64 (40, 40, 2, 2)``; for other objects, the repr."""
    dtype, shape = getattr(value, "dtype", None), getattr(value, "shape", None)
    return repr(value) if dtype is None or shape is None else f"{dtype} {tuple(shape)}"


def nan_outside(
    values: Float[Array, "*leading_and_shape"], known: Bool[np.ndarray | Array, "*_shape"]
) -> Float[Array, "*leading_and_shape"]:
    """Replace values where ``known`` is false, such as outside a mask, by NaN that `jax.debug_nans` ignores."""
    if isinstance(known, np.ndarray) and known.all():
        return values
    with jax.debug_nans(False):
        return jnp.where(known, values, jnp.nan)


def nan_is_meant(function: Callable[P, R]) -> Callable[P, R]:
    """Turn off `jax.debug_nans` within a function whose arguments may contain NaN from `nan_outside`."""

    @wraps(function)
    def run(*args: P.args, **kwargs: P.kwargs) -> R:
        with jax.debug_nans(False):
            return function(*args, **kwargs)

    return run
