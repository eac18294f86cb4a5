"""Metrics from symmetric tensors of either sign, such as stress, by a map of their eigenvalues that is stated."""

import math
from typing import Any, Literal, get_args

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hks_jax.checks import require_number
from hks_jax.domain import spd
from hks_jax.domain.tensor_checks import least_eigenvalue, require_finite_symmetric
from hks_jax.traced import is_traced

PositiveMap = Literal["exp", "shift"]

MAPS: dict[str, str] = {
    "exp": "exp(S/s), s a stress of your choice",
    "shift": "S + c·I, c above minus the least eigenvalue",
}
"""The choices, for messages."""

NUMBERS = {"exp": "scale", "shift": "shift"}
"""What the number of each map is called."""


def checked_map(how: Any) -> PositiveMap:
    """Return the name of a map; raise ValueError for any other."""
    if how not in get_args(PositiveMap):
        choices = " or ".join(f'"{name}" ({does})' for name, does in MAPS.items())
        raise ValueError(f"how: got {how!r}; expected {choices}. There is no default: choose one")
    return how


def check_number(name: str, how: PositiveMap, number: Any) -> None:
    """Raise ValueError unless it is a positive scale, or a finite shift; traced ones pass."""
    if number is None:
        raise ValueError(f"number: got None; expected the {NUMBERS[how]} of the map {how!r}, in the units of {name}")
    require_number("number", number, above=0.0 if how == "exp" else -math.inf)


def check_shift(name: str, tensors: Float[np.ndarray, "n d d"], how: PositiveMap, number: Any) -> None:
    """Raise ValueError unless a shift is above minus the least eigenvalue of the tensors."""
    least = least_eigenvalue(tensors)
    if how == "shift" and not float(number) + least > 0:
        raise ValueError(
            f"number: got the shift {float(number):g} of {name} whose least eigenvalue is {least:g}; expected more "
            f"than {-least:g}, so that S + c·I is positive definite"
        )


def check_mapped(
    tensors: Float[np.ndarray, "n d d"], mapped: Float[np.ndarray, "n d d"], how: PositiveMap, number: Any
) -> None:
    """Raise ValueError where the metric that a map gave is singular in its precision."""
    if not spd.is_spd(mapped).all():
        values = np.linalg.eigvalsh(tensors.astype(np.float64))
        raise ValueError(
            f"number: got the {NUMBERS[how]} {float(number):g} of tensors whose eigenvalues go from {values.min():.4g} "
            f"to {values.max():.4g}: the metric is singular in {mapped.dtype}; expected a larger number"
        )


def positive_map(
    name: str, tensors: Float[Array, "*shape d d"], how: PositiveMap, number: Any, inside: Bool[np.ndarray, "*shape"]
) -> Float[Array, "*shape d d"]:
    """Return exp(S/s) or S + c·I of symmetric tensors S at the nodes of a grid; the identity outside.

    Raises:
        ValueError: NaN, infinite or unsymmetric tensors; a number that leaves some of them not positive definite.
    """
    check_number(name, how, number)
    known = not is_traced((tensors, number))
    if known:
        require_finite_symmetric(name, np.asarray(tensors), inside, "node")
        check_shift(name, np.asarray(tensors)[inside], how, number)
    symmetric = spd.symmetrise(spd.identity_outside(tensors, inside))
    number = jnp.asarray(number, tensors.dtype)
    mapped = (
        spd.exp(symmetric / number)
        if how == "exp"
        else symmetric + number * jnp.eye(tensors.shape[-1], dtype=tensors.dtype)
    )
    if known:
        check_mapped(np.asarray(tensors)[inside], np.asarray(mapped)[inside], how, number)
    return mapped
