"""Checks of arguments that many functions share."""

import math
import operator
import os
from contextlib import suppress
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.arrays import describe_array, jax_array, nan_outside
from hks_jax.traced import is_traced


def require_number(
    name: str, value: Any, below: float = math.inf, *, above: float = 0.0, inclusive: bool = False
) -> None:
    """Raise ValueError unless a setting is a real number between two limits; traced numbers are not checked.

    The upper limit ``below`` is excluded. The lower limit ``above`` is excluded unless ``inclusive`` is set.
    """
    if is_traced(value):
        return
    array = np.asarray(value)
    if array.ndim == 0 and array.dtype.kind in "iuf":
        number = float(array)
        if above < number < below or (inclusive and number == above):
            return
    got = array if array.ndim == 0 and array.dtype.kind in "biufc" else repr(value)
    limits = f"{'from' if inclusive else 'above'} {above:g}" + ("" if math.isinf(below) else f" and below {below:g}")
    raise ValueError(f"{name}: got {got}; expected a finite number {limits}")


def require_real(name: str, values: Any) -> None:
    """Raise ValueError for complex numbers, texts and other objects, masked values, and types JAX does not support."""
    leaves = jax.tree.leaves(values)
    dtypes = [leaf.dtype if hasattr(leaf, "dtype") else np.dtype(type(leaf)) for leaf in leaves]
    kinds = [getattr(dtype, "kind", None) for dtype in dtypes]
    if any(kind in tuple("OSUMm") and not callable(leaf) for kind, leaf in zip(kinds, leaves, strict=True)):
        raise _no_numbers(name, values)
    if any(np.iscomplexobj(leaf) for leaf in leaves):
        raise ValueError(
            f"{name}: got complex numbers; expected real numbers. If imaginary parts are only rounding, pass .real"
        )
    if any(isinstance(leaf, np.ndarray) and leaf.dtype.kind == "f" and leaf.dtype.itemsize > 8 for leaf in leaves):
        raise ValueError(f"{name}: got {np.dtype(np.longdouble)}, which JAX does not support; use .astype(np.float64)")
    if any(isinstance(leaf, np.ma.MaskedArray) and np.ma.is_masked(leaf) for leaf in leaves):
        raise ValueError(f"{name}: got a masked array; expected an array without masked entries; use .filled(value)")


def real_array(name: str, values: Any) -> Array:
    """Return values as a JAX array of at least single precision, after the checks of `require_real`."""
    require_real(name, values)
    if isinstance(values, np.ndarray):
        values = values.astype(values.dtype.newbyteorder("="), copy=False)
    try:
        array = jax_array(values)
    except (TypeError, ValueError, NotImplementedError) as error:
        raise _no_numbers(name, values) from error
    if not jnp.issubdtype(array.dtype, jnp.floating):
        return array.astype(jnp.result_type(float))
    return array.astype(jnp.float32) if array.dtype.itemsize < 4 else array


def _no_numbers(name: str, values: Any) -> ValueError:
    parts = [part for part in ("tensors", "vertices", "todense()") if hasattr(values, part.rstrip("()"))]
    remedy = f". Pass its .{parts[0]}" if parts else ""
    if isinstance(values, str | os.PathLike):
        remedy = ". Read the file, and pass its array"
    return ValueError(f"{name}: got {describe_array(values)[:200]}; expected an array of numbers{remedy}")


def require_static(name: str, value: Any) -> None:
    """Raise ValueError for a traced argument that decides shapes or connectivity, and so must be known beforehand."""
    if is_traced(value):
        raise ValueError(
            f"{name}: got a traced value, an argument of a function under jax.jit, jax.vmap or jax.grad; expected a "
            "static value. Take it from outside of this function, or name the argument in static_argnames of jax.jit"
        )


def require_count(name: str, value: Any, least: int = 1) -> None:
    """Raise ValueError unless a setting is an integer of at least ``least``."""
    require_static(name, value)
    with suppress(TypeError):
        if operator.index(value) >= least:
            return
    raise ValueError(f"{name}: got {value!r}; expected an integer of at least {least}")


def checked_times(times: Any, dtype: Any) -> Float[Array, " n"]:
    """Return times as an array (n,), one time for a number; raise ValueError unless all are positive and finite.

    Traced times are NaN unless they are positive and finite.
    """
    require_real("times", times)
    try:
        is_array = isinstance(times, jax.Array) or is_traced(times)
        array = jnp.asarray(times, dtype) if is_array else jax_array(np.asarray(times, dtype))
    except (TypeError, ValueError):
        raise ValueError(f"times: got {times!r}; expected a 1-D array of positive numbers") from None
    if array.ndim > 1 or array.size == 0:
        raise ValueError(f"times: got shape {array.shape}; expected a number or a non-empty 1-D array")
    array = array.reshape(-1)
    if is_traced(array):
        return nan_outside(array, jnp.isfinite(array) & (array > 0))
    values = np.asarray(array)
    bad = ~(np.isfinite(values) & (values > 0))
    if bad.any():
        raise ValueError(f"times: got {values[bad][0]}; expected positive finite times")
    return array
