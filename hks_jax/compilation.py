"""Faster compilation for CPUs, and computations by NumPy without compilation."""

import os
from collections.abc import Callable
from functools import cache, partial, wraps
from typing import Any, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from hks_jax.traced import is_traced

P = ParamSpec("P")
T = TypeVar("T")

_OPTIONS: dict[str, bool | int | str] = {"xla_cpu_use_fusion_emitters": False, "xla_backend_optimization_level": 2}
"""XLA's older code generator for fused loops compiles twice as fast. The measured speed of its code is the same."""


def jit_quickly(jit: Callable = jax.jit, **settings: Any) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """Return a decorator like `jax.jit`, or `equinox.filter_jit`, for functions that take long to compile.

    XLA compiles a computation as a whole: within another one these functions are as that is. Where the environment
    variable XLA_FLAGS sets one of the options, they are left as it says.
    """

    def decorate(function: Callable[P, T]) -> Callable[P, T]:
        usual = jit(function, **settings)
        quick = jit(function, compiler_options=_OPTIONS, **settings)

        @wraps(function)
        def call(*args: P.args, **kwargs: P.kwargs) -> T:
            # Nothing comes of an operation but a tracer where all operations are part of a computation to come.
            within = is_traced((args, kwargs, jnp.zeros(())))
            return usual(*args, **kwargs) if within or not _understood() else quick(*args, **kwargs)

        return call

    return decorate


_FEW = 1 << 19
"""The number of values up to which NumPy is faster than compiling a program, even for many calls."""


def numpy_where_known(**settings: Any) -> Callable[[Callable[..., T]], Callable[..., T]]:
    """Return a decorator for functions whose first argument is the array module, NumPy's or JAX's.

    NumPy computes with few concrete values on a CPU, so nothing is compiled. Otherwise `jax.jit` with the settings
    compiles the function. The results are JAX arrays in both cases.
    """

    def decorate(function: Callable[..., T]) -> Callable[..., T]:
        compiled = jax.jit(partial(function, jnp), **settings)

        @wraps(function)
        def call(*args: Any) -> T:
            return by_numpy(partial(function, np), *args) if known_and_few(args) else compiled(*args)

        return call

    return decorate


def by_numpy(function: Callable[..., Any], *args: Any) -> Any:
    """Apply a function to NumPy arrays instead of JAX arrays; return its result as JAX arrays."""
    known = jax.tree.map(lambda x: np.asarray(x) if isinstance(x, jax.Array) else x, args)
    with np.errstate(all="ignore"):
        # `jnp.asarray` would return NumPy arrays while JAX differentiates.
        return jax.device_put(jax.tree.map(np.asarray, function(*known)))


def known_and_few(args: Any) -> bool:
    """Return whether values are `known_here` and few, so that NumPy computes with them.

    The answer depends only on shapes and devices, so that repeated computations have the same rounding errors.
    """
    return known_here(args) and sum(np.size(leaf) for leaf in jax.tree.leaves(args)) <= _FEW


def known_here(args: Any) -> bool:
    """Return whether values are concrete, and on one CPU of this process alone."""
    if is_traced((args, jnp.zeros(()))) or jax.default_backend() != "cpu" or jax.process_count() > 1:
        return False
    return all(len(leaf.devices()) == 1 for leaf in jax.tree.leaves(args) if isinstance(leaf, jax.Array))


@cache
def _understood() -> bool:
    """Return whether the default device is a CPU whose compiler accepts the options, none of which XLA_FLAGS sets."""
    if jax.default_backend() != "cpu" or any(option in os.environ.get("XLA_FLAGS", "") for option in _OPTIONS):
        return False
    try:
        jax.jit(lambda: jnp.zeros(()), compiler_options=_OPTIONS).lower().compile()
    except jax.errors.JaxRuntimeError:
        return False
    return True
