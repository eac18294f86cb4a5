"""NumPy or XLA: functions that NumPy computes where compilation would take longer, and faster compilation for CPUs."""

import os
from collections.abc import Callable
from functools import cache, wraps
from typing import Any, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from hks_jax.traced import is_staged, is_traced

P = ParamSpec("P")
T = TypeVar("T")

_OPTIONS: dict[str, bool | int | str] = {"xla_cpu_use_fusion_emitters": False, "xla_backend_optimization_level": 2}
"""Compiler options that halve the time of compilation. In measurements, the options did not slow compiled code."""


def is_concrete_on_cpu(args: Any) -> bool:
    """Return whether all values are concrete, and each array is stored on one CPU device of a single process."""
    if jax.default_backend() != "cpu" or jax.process_count() > 1 or is_traced(args) or is_staged():
        return False
    return all(len(leaf.devices()) == 1 for leaf in jax.tree.leaves(args) if isinstance(leaf, jax.Array))


def jit_quickly(jit: Callable = jax.jit, **settings: Any) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """Return a decorator like `jax.jit`, or `equinox.filter_jit`, that compiles faster on CPUs.

    The compiler options apply only to calls outside `jax.jit` with concrete values, because XLA compiles an enclosing
    function as a whole, and JAX accepts no options for derivatives. If the environment variable XLA_FLAGS sets one of
    these options, the decorator sets none of them.
    """

    def decorate(function: Callable[P, T]) -> Callable[P, T]:
        usual = jit(function, **settings)
        quick = jit(function, compiler_options=_OPTIONS, **settings)

        @wraps(function)
        def call(*args: P.args, **kwargs: P.kwargs) -> T:
            alone = jax.default_backend() == "cpu" and not is_staged() and not is_traced((args, kwargs))
            return (quick if alone and _understood() else usual)(*args, **kwargs)

        return call

    return decorate


@cache
def _understood() -> bool:
    """Return whether the compiler accepts the options of `jit_quickly`, and XLA_FLAGS sets none of them."""
    if any(option in os.environ.get("XLA_FLAGS", "") for option in _OPTIONS):
        return False
    try:
        jax.jit(lambda: jnp.zeros(()), compiler_options=_OPTIONS).lower().compile()
    except jax.errors.JaxRuntimeError:
        return False
    return True


def compiler_options() -> dict[str, bool | int | str]:
    """Return the ``compiler_options`` of `jax.jit` with which a CPU's compiler is faster.

    Pass the options to your outermost `jax.jit` or `equinox.filter_jit`; functions of this package that you call
    outside `jax.jit` have them already. With the options, the gradient of a signature compiles in two thirds of the
    time and in half of the memory, and then runs as fast as without. JAX refuses the options if the compiled function
    is called within another `jax.jit` or differentiated by `jax.grad`: take derivatives inside, as in the example.

    Returns:
        The options; an empty dictionary if JAX's default device is no CPU, if the environment variable XLA_FLAGS sets
        one of the options, or if the compiler does not know them.

    Examples:
        >>> def trace(T):
        ...     return hj.heat_trace(hj.eigenpairs(hj.TensorField(field.grid, T), k=12), [0.1]).sum()
        >>> step = jax.jit(jax.value_and_grad(trace), compiler_options=hj.compiler_options())
        >>> value, gradient = step(field.tensors)
        >>> gradient.shape
        (9, 9, 2, 2)
    """
    return dict(_OPTIONS) if jax.default_backend() == "cpu" and _understood() else {}


_FEW = 1 << 19
"""The largest total number of array entries for which many calls of NumPy take less time than one compilation."""


def numpy_where_known(most: int = _FEW, **settings: Any) -> Callable[[Callable[..., T]], Callable[..., T]]:
    """Return a decorator for functions that compute with the library of their arrays (`library_of`).

    If the arguments are concrete, on a CPU, and have at most ``most`` entries, the function is evaluated without
    compilation, with NumPy arrays in place of JAX arrays and SciPy matrices in place of operators. Otherwise, the
    function is compiled by `jit_quickly` with the settings. The results are JAX arrays in both cases. Sizes and devices
    decide between NumPy and XLA, so that repeated computations on concrete arrays round equally.
    """

    def decorate(function: Callable[..., T]) -> Callable[..., T]:
        compiled = jit_quickly(**settings)(function)

        @wraps(function)
        def call(*args: Any) -> T:
            is_small = sum(np.size(leaf) for leaf in jax.tree.leaves(args)) <= most
            return by_numpy(function, *args) if is_small and is_concrete_on_cpu(args) else compiled(*args)

        return call

    return decorate


def library_of(*arrays: Any) -> Any:
    """Return `numpy` if all arrays are NumPy's, and otherwise `jax.numpy`: the library that computes with them."""
    return np if all(isinstance(array, np.ndarray | np.generic) for array in arrays) else jnp


def by_numpy(function: Callable[..., Any], *args: Any) -> Any:
    """Evaluate a function with NumPy arrays and SciPy matrices; return its result as JAX arrays."""

    def on_host(x: Any) -> Any:
        return x.to_scipy() if hasattr(x, "to_scipy") else np.asarray(x) if isinstance(x, jax.Array) else x

    known = jax.tree.map(on_host, args, is_leaf=lambda x: hasattr(x, "to_scipy"))
    with np.errstate(all="ignore"):
        # During differentiation, `jnp.asarray` would return NumPy arrays.
        return jax.device_put(jax.tree.map(np.asarray, function(*known)))
