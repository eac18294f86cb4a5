"""Faster compilation for CPUs, and computation by NumPy without compilation."""

import inspect
import os
from collections.abc import Callable, Sequence
from functools import cache, partial, wraps
from types import SimpleNamespace
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
"""Compiler options that halve the time of compilation. In measurements, the options did not slow compiled code."""

NumPyRule = Callable[[SimpleNamespace, SimpleNamespace | None, list[Any] | None], Any]
"""A rule (primals, x, y) that computes a function or its derivative by NumPy, or returns None if it cannot.

The primals are all arguments of the function, by their names, x are tangents of some arguments, and y are cotangents of
the leaves of the function's result. If x and y are None, the rule returns the function's result. If only y is None, the
rule returns the tangent of the result. If y is given, x contains only the shapes of the tangents, and the rule returns
the cotangents of the arguments that x describes, by their names. If the function is linear, the primals contain None
for linear arguments.
"""


def jit_quickly(
    jit: Callable = jax.jit,
    linear: tuple[str, ...] = (),
    shapes: Callable[..., Any] = lambda *args: None,
    numpy_rule: NumPyRule | None = None,
    **settings: Any,
) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """Return a decorator like `jax.jit`, or `equinox.filter_jit`, that compiles faster on CPUs.

    Compiler options apply only to calls outside `jax.jit`, because XLA compiles an enclosing function as a whole. If
    the environment variable XLA_FLAGS sets one of these options, the decorator sets none of them.

    Args:
        jit: the decorator that compiles.
        linear: the names of the arguments in which the function is jointly linear.
        shapes: for a linear function, the function that maps all arguments to a pytree with the shapes of the result.
        numpy_rule: the rule that computes the function and its derivatives by NumPy for concrete arguments on a CPU.
        settings: the keyword arguments of ``jit``.
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
            if jax.default_backend() != "cpu" or is_staged():
                return usual(*args, **kwargs)
            bound = signature.bind(*args, **kwargs)
            if not linear and not is_traced((args, kwargs)):
                found = _apply(numpy_rule, tuple(bound.arguments), bound.args, None, None)
                return found if found is not None else (quick if _understood() else usual)(*args, **kwargs)
            given = {name: None if name in static else x for name, x in bound.arguments.items()}
            moved = [jax.tree.map(partial(is_moved, name), x) for name, x in given.items()]
            parts = eqx.partition(list(given.values()), moved)[::-1]
            known, x = map(jax.tree.leaves, parts)
            if whole or is_traced(known) or not all(map(_is_inexact, x)):
                return usual(*args, **kwargs)
            fixed = tuple(bound.arguments[name] if name in static else None for name in given)
            program = _Program(usual, tuple(given), fixed, jax.tree.structure(parts), numpy_rule)
            if not linear:
                return _differentiable(program, known, x)
            results, structure = jax.tree.flatten(shapes(*bound.args))
            linear_map = _LinearMap(program, False, _shapes(x), _shapes(results))
            return jax.tree.unflatten(structure, _linear.bind(*known, *x, linear_map=linear_map))

        return call

    return decorate


_FEW = 1 << 19
"""The largest total number of array entries for which many calls of NumPy take less time than one compilation."""


def numpy_where_known(
    jit: Callable | None = None, most: int = _FEW, **settings: Any
) -> Callable[[Callable[..., T]], Callable[..., T]]:
    """Return a decorator for functions whose first argument is the array module, `numpy` or `jax.numpy`.

    If the arguments are concrete, on a CPU, and have at most ``most`` entries, the function is evaluated without
    compilation, with NumPy arrays in place of JAX arrays and SciPy matrices in place of operators. Otherwise, the
    function is compiled by ``jit``, by default `jax.jit` with the settings. The results are JAX arrays in both cases.
    Sizes and devices decide between NumPy and ``jit``, so that repeated computations on concrete arrays round equally.
    """

    def decorate(function: Callable[..., T]) -> Callable[..., T]:
        compiled = (jit or partial(jax.jit, **settings))(partial(function, jnp))

        @wraps(function)
        def call(*args: Any) -> T:
            is_small = sum(np.size(leaf) for leaf in jax.tree.leaves(args)) <= most
            return by_numpy(partial(function, np), *args) if is_small and is_concrete_on_cpu(args) else compiled(*args)

        return call

    return decorate


def by_numpy(function: Callable[..., Any], *args: Any) -> Any:
    """Evaluate a function with NumPy arrays and SciPy matrices; return its result as JAX arrays."""

    def on_host(x: Any) -> Any:
        return x.to_scipy() if hasattr(x, "to_scipy") else np.asarray(x) if isinstance(x, jax.Array) else x

    known = jax.tree.map(on_host, args, is_leaf=lambda x: hasattr(x, "to_scipy"))
    with np.errstate(all="ignore"):
        # During differentiation, `jnp.asarray` would return NumPy arrays.
        return jax.device_put(jax.tree.map(np.asarray, function(*known)))


def is_concrete_on_cpu(args: Any) -> bool:
    """Return whether all values are concrete, and each array is stored on one CPU device of a single process."""
    if jax.default_backend() != "cpu" or jax.process_count() > 1 or is_traced(args) or is_staged():
        return False
    return all(len(leaf.devices()) == 1 for leaf in jax.tree.leaves(args) if isinstance(leaf, jax.Array))


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


class _Program(NamedTuple):
    """A function of a flat list of arrays and of static arguments. Equal instances share one compilation."""

    function: Callable[..., Any]
    names: tuple[str, ...]
    fixed: tuple[Any, ...]
    structure: jax.tree_util.PyTreeDef
    numpy_rule: NumPyRule | None

    def __call__(self, *leaves: Any) -> Any:
        return self.function(*self.args(*leaves))

    def args(self, *leaves: Any) -> list[Any]:
        return [known if x is None else eqx.combine(known, x) for known, x in zip(*self.split(*leaves), strict=True)]

    def split(self, *leaves: Any) -> tuple[list[Any], list[Any]]:
        """Return the constant and the differentiated arguments; each list has None for the other list's leaves."""
        known, x = jax.tree.unflatten(self.structure, leaves)
        return [own if fixed is None else fixed for own, fixed in zip(known, self.fixed, strict=True)], x

    def by_numpy(self, *leaves: Any) -> Any:
        """Evaluate the function by NumPy, or return None if there is no rule or values are not concrete on one CPU."""
        return _apply(self.numpy_rule, self.names, self.args(*leaves), None, None)


class _LinearMap(NamedTuple):
    """A linear map, or its transpose, as a function of constant arrays followed by the linear inputs.

    Attributes:
        program: the function, which must be linear in its last arguments if `tangent` is false.
        tangent: if true, the map is the derivative of the program with respect to the program's last arguments; the
            last constants are the values of these arguments.
        x: the shapes of the inputs of the untransposed map.
        y: the shapes of the results of the untransposed map.
        transposed: whether the map is transposed.
    """

    program: _Program
    tangent: bool
    x: tuple[jax.ShapeDtypeStruct, ...]
    y: tuple[jax.ShapeDtypeStruct, ...]
    transposed: bool = False

    def split(self, leaves: Sequence[Any]) -> tuple[list[Any], list[Any]]:
        n = len(leaves) - len(self.y if self.transposed else self.x)
        return list(leaves[:n]), list(leaves[n:])

    def __call__(self, *leaves: Any) -> list[Any]:
        known, rest = self.split(leaves)

        def forward(*x: Any) -> list[Any]:
            if not self.tangent:
                return jax.tree.leaves(self.program(*known, *x))
            n = len(known) - len(x)
            return jax.tree.leaves(jax.jvp(lambda *x: self.program(*known[:n], *x), tuple(known[n:]), x)[1])

        return list(jax.linear_transpose(forward, *self.x)(rest)) if self.transposed else forward(*rest)

    def by_numpy(self, *leaves: Any) -> Any:
        """Apply the map by NumPy, or return None if there is no rule or values are not concrete on one CPU."""
        known, rest = self.split(leaves)
        x, y = (self.x, [np.asarray(each) for each in rest]) if self.transposed else (rest, None)
        args, change = self.program.split(*known[: len(known) - self.tangent * len(x)], *x)
        own = self.program.args(*known) if self.tangent else args
        return _apply(self.program.numpy_rule, self.program.names, own, change, y)


def _is_inexact(leaf: Any) -> bool:
    return jax.dtypes.issubdtype(jax.typeof(leaf).dtype, np.inexact)


@jit_quickly(static_argnums=0)
def _call(function: Any, *leaves: Any) -> Any:
    return function(*leaves)


def _apply(
    rule: NumPyRule | None, names: tuple[str, ...], known: Sequence[Any], x: list[Any] | None, y: list[Any] | None
) -> Any:
    if rule is None or not is_concrete_on_cpu((known, x, y)):
        return None
    primals = SimpleNamespace(**dict(zip(names, known, strict=True)))
    tangents = None if x is None else SimpleNamespace(**dict(zip(names, x, strict=True)))
    with np.errstate(all="ignore"):
        result = rule(primals, tangents, y)
    return jax.device_put(result if y is None or result is None else [result[name] for name in names if name in result])


def _computed(function: _Program | _LinearMap, *leaves: Any) -> Any:
    with jax.core.eval_context():
        found = function.by_numpy(*leaves)
        return _call(function, *leaves) if found is None else found


def _shapes(leaves: Sequence[Any]) -> tuple[jax.ShapeDtypeStruct, ...]:
    return tuple(jax.ShapeDtypeStruct(each.shape, each.dtype) for each in map(jax.typeof, leaves))


# JAX accepts no compiler options for the programs that it generates for derivatives, and splits a derivative into
# several programs. If all values are concrete, as outside `jax.jit`, `_differentiable` compiles the tangent map as one
# program, and the transposed tangent map as another. For traced values, JAX differentiates the program.
def _differentiable(program: _Program, known: list[Any], x: list[Any]) -> Any:
    """Evaluate a program so that its derivative with respect to x is one compiled program."""

    @jax.custom_jvp
    def call(*x: Any) -> Any:
        return program(*known, *x)

    @call.defjvp
    def rule(x: tuple[Any, ...], change: tuple[Any, ...]) -> tuple[Any, Any]:
        result = None if is_traced(x) else _computed(program, *known, *x)
        leaves, structure = jax.tree.flatten(result)
        if not (leaves and all(map(_is_inexact, leaves))):
            return jax.jvp(lambda *x: program(*known, *x), x, change)
        linear_map = _LinearMap(program, True, _shapes(x), _shapes(leaves))
        return result, jax.tree.unflatten(structure, _linear.bind(*known, *x, *change, linear_map=linear_map))

    return call(*x)


_linear = Primitive("linear_program")
_linear.multiple_results = True
_linear.def_impl(lambda *leaves, linear_map: jax.tree.leaves(_computed(linear_map, *leaves)))


@_linear.def_abstract_eval
def _abstract(*leaves: Any, linear_map: Any) -> list[Any]:
    results = linear_map.x if linear_map.transposed else linear_map.y
    return [jax.core.ShapedArray(result.shape, result.dtype) for result in results]


def _full(changes: Sequence[Any]) -> list[Any]:
    def full(change: Any) -> Any:
        shape: Any = change.aval if isinstance(change, ad.Zero) else None
        return change if shape is None else np.zeros(shape.shape, shape.dtype)

    return list(map(full, changes))


def _transpose(cotangents: list[Any], *leaves: Any, linear_map: _LinearMap) -> list[Any]:
    known, x = linear_map.split(leaves)
    transpose = linear_map._replace(transposed=not linear_map.transposed)
    results = _linear.bind(*known, *_full(cotangents), linear_map=transpose)
    wanted = map(ad.is_undefined_primal, x)
    return [None] * len(known) + [result if each else None for result, each in zip(results, wanted, strict=True)]


def _jvp(leaves: tuple[Any, ...], change: tuple[Any, ...], linear_map: _LinearMap) -> tuple[list[Any], list[Any]]:
    (known, _), (d_known, d_rest) = linear_map.split(leaves), linear_map.split(change)
    if all(isinstance(d, ad.Zero) for d in d_known):
        return _linear.bind(*leaves, linear_map=linear_map), _linear.bind(*known, *_full(d_rest), linear_map=linear_map)
    moved = {i: d for i, d in enumerate(change) if not isinstance(d, ad.Zero)}

    def of_varied(*some: Any) -> list[Any]:
        return linear_map(*(dict(enumerate(leaves)) | dict(zip(moved, some, strict=True))).values())

    return jax.jvp(of_varied, tuple(leaves[i] for i in moved), tuple(moved.values()))


def _batch(leaves: tuple[Any, ...], axes: tuple[Any, ...], linear_map: _LinearMap) -> tuple[list[Any], list[int]]:
    results = jax.vmap(lambda *leaves: linear_map(*leaves), in_axes=tuple(axes))(*leaves)
    return results, [0] * len(results)


ad.primitive_transposes[_linear] = _transpose
ad.primitive_jvps[_linear] = _jvp
batching.primitive_batchers[_linear] = _batch
mlir.register_lowering(_linear, mlir.lower_fun(lambda *leaves, linear_map: linear_map(*leaves), multiple_results=True))
