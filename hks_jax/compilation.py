"""Faster compilation for CPUs, and computations by NumPy without compilation."""

import inspect
import os
from collections.abc import Callable, Sequence
from functools import cache, partial, wraps
from typing import Any, NamedTuple, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from hks_jax.traced import is_staged, is_traced

P = ParamSpec("P")
T = TypeVar("T")

_OPTIONS: dict[str, bool | int | str] = {"xla_cpu_use_fusion_emitters": False, "xla_backend_optimization_level": 2}
"""XLA's older code generator for fused loops compiles twice as fast. The measured speed of its code is the same."""


OnHost = Callable[[list[Any], list[Any] | None, list[Any] | None], Any]
"""A function that computes by NumPy, given all arguments, changes x of some, and cotangents y of the result's leaves.

If x and y are None, it returns the function's result. If only x is given, it returns the change of the result. If y is
given, it returns the cotangents of x, where x has only shapes. If the function is linear in x, the arguments do not
include x. None means that the function must be compiled.
"""


def jit_quickly(
    jit: Callable = jax.jit,
    linear: tuple[str, ...] = (),
    like: Callable[..., Any] = lambda *args: None,
    on_host: OnHost | None = None,
    **settings: Any,
) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """Return a decorator like `jax.jit`, or `equinox.filter_jit`, for functions that take long to compile.

    XLA compiles a computation as a whole, so these options have no effect within another computation. If the
    environment variable XLA_FLAGS sets one of the options, none is changed.

    Args:
        jit: the function that compiles.
        linear: the names of arguments in which the function is jointly linear.
        like: a function that returns the shapes of the result, given all arguments of a linear function.
        on_host: a function that computes instead if values are concrete and few, on a CPU.
        settings: the settings of ``jit``.
    """

    def decorate(function: Callable[P, T]) -> Callable[P, T]:
        usual = jit(function, **settings)
        quick = jit(function, compiler_options=_OPTIONS, **settings)
        whole = jit is not jax.jit or any("donate" in name for name in settings)
        names = settings.get("static_argnames", ())
        signature, static = inspect.signature(function), (names,) if isinstance(names, str) else tuple(names)

        def is_moved(name: str, leaf: Any) -> bool:
            return name in linear and _is_inexact(leaf) if linear else is_traced(leaf)

        @wraps(function)
        def call(*args: P.args, **kwargs: P.kwargs) -> T:
            if is_staged() or not _understood():
                return usual(*args, **kwargs)
            bound = signature.bind(*args, **kwargs)
            if not linear and not is_traced((args, kwargs)):
                found = _on_host(on_host, bound.args, None, None)
                return quick(*args, **kwargs) if found is None else found
            given = {name: None if name in static else x for name, x in bound.arguments.items()}
            moved = [jax.tree.map(partial(is_moved, name), x) for name, x in given.items()]
            parts = eqx.partition(list(given.values()), moved)[::-1]
            known, x = map(jax.tree.leaves, parts)
            if whole or is_traced(known) or not all(map(_is_inexact, x)):
                return usual(*args, **kwargs)
            fixed = tuple(bound.arguments[name] if name in static else None for name in given)
            program = _Program(usual, fixed, jax.tree.structure(parts), on_host)
            if not linear:
                return _differentiable(program, known, x)
            results, structure = jax.tree.flatten(like(*bound.args))
            of = _Map(program, False, _shapes(x), _shapes(results))
            return jax.tree.unflatten(structure, _linear.bind(*known, *x, of=of))

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
    """Return whether values are concrete and on a single CPU of the only process."""
    if is_staged() or is_traced(args) or jax.default_backend() != "cpu" or jax.process_count() > 1:
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


class _Program(NamedTuple):
    """A function of a flat list of arrays with its static arguments. Equal programs share their compilation."""

    function: Callable[..., Any]
    fixed: tuple[Any, ...]
    structure: jax.tree_util.PyTreeDef
    host: OnHost | None

    def __call__(self, *leaves: Any) -> Any:
        """Return the result of the function."""
        return self.function(*self.args(*leaves))

    def args(self, *leaves: Any) -> list[Any]:
        """Return the arguments."""
        return [known if x is None else eqx.combine(known, x) for known, x in zip(*self.split(*leaves), strict=True)]

    def split(self, *leaves: Any) -> tuple[list[Any], list[Any]]:
        """Return the concrete arguments and the others."""
        known, x = jax.tree.unflatten(self.structure, leaves)
        return [own if fixed is None else fixed for own, fixed in zip(known, self.fixed, strict=True)], x

    def on_host(self, *leaves: Any) -> Any:
        """Return the result of the function by NumPy, or None."""
        return _on_host(self.host, self.args(*leaves), None, None)


class _Map(NamedTuple):
    """A linear map or its transpose. Its arguments are concrete arrays, followed by those in which it is linear.

    Attributes:
        program: a program that is linear in its last arguments.
        at: whether to take the program's derivative by these arguments, whose values and changes are then given.
        x: the shapes of the arguments in which the map is linear.
        y: the shapes of the results.
        transposed: whether to transpose the map.
    """

    program: _Program
    at: bool
    x: tuple[jax.ShapeDtypeStruct, ...]
    y: tuple[jax.ShapeDtypeStruct, ...]
    transposed: bool = False

    def split(self, leaves: Sequence[Any]) -> tuple[list[Any], list[Any]]:
        """Return the concrete arguments and the rest."""
        n = len(leaves) - len(self.y if self.transposed else self.x)
        return list(leaves[:n]), list(leaves[n:])

    def __call__(self, *leaves: Any) -> list[Any]:
        """Apply the map to arrays."""
        known, rest = self.split(leaves)

        def forward(*x: Any) -> list[Any]:
            if not self.at:
                return jax.tree.leaves(self.program(*known, *x))
            n = len(known) - len(x)
            return jax.tree.leaves(jax.jvp(lambda *x: self.program(*known[:n], *x), known[n:], x)[1])

        return list(jax.linear_transpose(forward, *self.x)(rest)) if self.transposed else forward(*rest)

    def on_host(self, *leaves: Any) -> Any:
        """Apply the map to arrays by NumPy, or return None."""
        known, rest = self.split(leaves)
        x, y = (self.x, [np.asarray(each) for each in rest]) if self.transposed else (rest, None)
        args, change = self.program.split(*known[: len(known) - self.at * len(x)], *x)
        return _on_host(self.program.host, self.program.args(*known) if self.at else args, change, y)


def _is_inexact(leaf: Any) -> bool:
    return jax.dtypes.issubdtype(leaf.dtype, np.inexact)


@partial(jax.jit, static_argnums=0, compiler_options=_OPTIONS)
def _quick(function: Callable[..., Any], *leaves: Any) -> Any:
    return function(*leaves)


def _on_host(host: OnHost | None, known: Sequence[Any], *others: list[Any] | None) -> Any:
    if host is None or not known_here((known, others)):
        return None
    with np.errstate(all="ignore"):
        return jax.device_put(host(list(known), *others))


def _computed(function: _Program | _Map, *leaves: Any) -> Any:
    with jax.core.eval_context():
        found = function.on_host(*leaves)
        return _quick(function, *leaves) if found is None else found


def _shapes(leaves: Sequence[Any]) -> tuple[jax.ShapeDtypeStruct, ...]:
    return tuple(jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in leaves)


# JAX takes no compiler options for the programs that it generates for derivatives, and generates several for one
# derivative. Here a derivative outside of `jax.jit`, where values are concrete, is one program, and its transpose is
# another. Everywhere else a derivative consists of JAX's operations, as without this module.
def _differentiable(program: _Program, known: list[Any], x: list[Any]) -> Any:
    """Return the result of a program so that it is differentiable by x."""

    @jax.custom_jvp
    def call(*x: Any) -> Any:
        return program(*known, *x)

    @call.defjvp
    def rule(x: tuple[Any, ...], change: tuple[Any, ...]) -> tuple[Any, Any]:
        result = None if is_traced(x) else _computed(program, *known, *x)
        leaves, structure = jax.tree.flatten(result)
        if not (leaves and all(map(_is_inexact, leaves))):
            return jax.jvp(lambda *x: program(*known, *x), x, change)
        of = _Map(program, True, _shapes(x), _shapes(leaves))
        return result, jax.tree.unflatten(structure, _linear.bind(*known, *x, *change, of=of))

    return call(*x)


_linear = Primitive("linear_program")
_linear.multiple_results = True
_linear.def_impl(lambda *leaves, of: jax.tree.leaves(_computed(of, *leaves)))


@_linear.def_abstract_eval
def _abstract(*leaves: Any, of: Any) -> list[Any]:
    return [jax.core.ShapedArray(shape.shape, shape.dtype) for shape in (of.x if of.transposed else of.y)]


def _full(changes: Sequence[Any]) -> list[Any]:
    def full(change: Any) -> Any:
        shape: Any = change.aval if isinstance(change, ad.Zero) else None
        return change if shape is None else np.zeros(shape.shape, shape.dtype)

    return list(map(full, changes))


def _transpose(cotangents: list[Any], *leaves: Any, of: _Map) -> list[Any]:
    known, x = of.split(leaves)
    results = _linear.bind(*known, *_full(cotangents), of=of._replace(transposed=not of.transposed))
    wanted = map(ad.is_undefined_primal, x)
    return [None] * len(known) + [result if each else None for result, each in zip(results, wanted, strict=True)]


def _jvp(leaves: tuple[Any, ...], change: tuple[Any, ...], of: _Map) -> tuple[list[Any], list[Any]]:
    (known, _), (d_known, d_rest) = of.split(leaves), of.split(change)
    if all(isinstance(d, ad.Zero) for d in d_known):
        return _linear.bind(*leaves, of=of), _linear.bind(*known, *_full(d_rest), of=of)
    moved = {i: d for i, d in enumerate(change) if not isinstance(d, ad.Zero)}

    def of_moved(*some: Any) -> list[Any]:
        return of(*(dict(enumerate(leaves)) | dict(zip(moved, some, strict=True))).values())

    return jax.jvp(of_moved, tuple(leaves[i] for i in moved), tuple(moved.values()))


def _batch(leaves: tuple[Any, ...], axes: tuple[Any, ...], of: _Map) -> tuple[list[Any], list[int]]:
    results = jax.vmap(lambda *leaves: of(*leaves), in_axes=tuple(axes))(*leaves)
    return results, [0] * len(results)


ad.primitive_transposes[_linear] = _transpose
ad.primitive_jvps[_linear] = _jvp
batching.primitive_batchers[_linear] = _batch
mlir.register_lowering(_linear, mlir.lower_fun(lambda *leaves, of: of(*leaves), multiple_results=True))
