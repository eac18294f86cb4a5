"""NaN where a value is not known, such as outside a mask: `jax.debug_nans` must not take it for a mistake."""

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

P = ParamSpec("P")
R = TypeVar("R")


def nan_outside(
    values: Float[Array, "*leading_and_shape"], known: Bool[np.ndarray | Array, "*_shape"]
) -> Float[Array, "*leading_and_shape"]:
    """Put NaN where a value is not known."""
    if isinstance(known, np.ndarray) and known.all():
        return values
    with jax.debug_nans(False):
        return jnp.where(known, values, jnp.nan)


def nan_is_meant(function: Callable[P, R]) -> Callable[P, R]:
    """Decorate a function that computes with such values."""

    @wraps(function)
    def run(*args: P.args, **kwargs: P.kwargs) -> R:
        with jax.debug_nans(False):
            return function(*args, **kwargs)

    return run
