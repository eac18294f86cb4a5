"""Compiling for CPUs in half the time, or not at all."""

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
"""XLA's older code generator for fused loops takes half as long, for code as fast as far as measured here."""


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
"""Numbers that NumPy computes with in less time than it takes to compile a program for them, even for many calls."""


def numpy_where_known(**settings: Any) -> Callable[[Callable[..., T]], Callable[..., T]]:
    """Return a decorator for functions that take the module of arrays, NumPy's or JAX's, first.

    With concrete values on a CPU, if they are few, NumPy computes, for which nothing is compiled; else `jax.jit` with
    the settings. What comes out are JAX's arrays.
    """

    def decorate(function: Callable[..., T]) -> Callable[..., T]:
        compiled = jax.jit(partial(function, jnp), **settings)

        @wraps(function)
        def call(*args: Any) -> T:
            return by_numpy(partial(function, np), *args) if known_and_few(args) else compiled(*args)

        return call

    return decorate


def by_numpy(function: Callable[..., Any], *args: Any) -> Any:
    """Return what a function makes of NumPy's arrays in place of JAX's, as JAX's arrays."""
    known = jax.tree.map(lambda x: np.asarray(x) if isinstance(x, jax.Array) else x, args)
    with np.errstate(all="ignore"):
        # `asarray` leaves them NumPy's where JAX differentiates.
        return jax.device_put(jax.tree.map(np.asarray, function(*known)))


def known_and_few(args: Any) -> bool:
    """Return whether values are `known_here` and few: then NumPy computes.

    It depends on shapes and devices alone, so that a computation has the same rounding each time.
    """
    return known_here(args) and sum(np.size(leaf) for leaf in jax.tree.leaves(args)) <= _FEW


def known_here(args: Any) -> bool:
    """Return whether values are concrete, and on one CPU of this process alone."""
    if is_traced((args, jnp.zeros(()))) or jax.default_backend() != "cpu" or jax.process_count() > 1:
        return False
    return all(len(leaf.devices()) == 1 for leaf in jax.tree.leaves(args) if isinstance(leaf, jax.Array))


@cache
def _understood() -> bool:
    """Return whether computations run on a CPU whose compiler has these options, and leaves them to us."""
    if jax.default_backend() != "cpu" or any(option in os.environ.get("XLA_FLAGS", "") for option in _OPTIONS):
        return False
    try:
        jax.jit(lambda: jnp.zeros(()), compiler_options=_OPTIONS).lower().compile()
    except jax.errors.JaxRuntimeError:
        return False
    return True
