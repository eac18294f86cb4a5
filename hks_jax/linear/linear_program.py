"""Linear maps in derivative rules: outside `jax.jit`, NumPy computes them, or one compiled program for each.

For example, the derivative of r = 1/a for each entry of an array is the linear map da ↦ −r da r, with the constant r::

    def change_of_reciprocals(r, da):
        return -r * da * r

    def host_map(r):
        r = np.asarray(r)
        return HostMap(lambda da: -r * np.asarray(da) * r, lambda like, y: -r * y * r)

    @jax.custom_jvp
    def reciprocals(a):
        return 1 / a

    @reciprocals.defjvp
    def _reciprocals_jvp(primals, tangents):
        r = reciprocals(*primals)
        return r, linear_program(change_of_reciprocals, (), (r,), *tangents, r, host_map)

Forward mode calls the map, and reverse mode its transpose.
"""

from collections.abc import Callable, Hashable, Sequence
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from hks_jax.compilation import is_concrete_on_cpu, jit_quickly


class HostMap(NamedTuple):
    """The products of a linear map y = Ax and of its transpose, by NumPy.

    Attributes:
        apply: the function x ↦ Ax.
        transpose: the function (like, y) ↦ Aᵀy, where ``like`` is a pytree with the shapes and dtypes of x.
    """

    apply: Callable[[Any], Any]
    transpose: Callable[[Any, Any], Any]


# Outside `jax.jit`, JAX splits a derivative into several programs, and compiles them without options. A map whose
# constants are concrete is therefore a primitive of its own, which evaluates the map, or its transpose, as a whole.
def linear_program(
    function: Callable[..., Any],
    settings: tuple[Hashable, ...],
    constants: tuple[Any, ...],
    x: Any,
    y: Any,
    host_map: Callable[..., HostMap | None] | None = None,
) -> Any:
    """Return y = function(*settings, *constants, x), which is linear in the floating-point arrays of x.

    Under `jax.jit`, under `jax.vmap` over constants, and on accelerators, JAX transposes the function.

    Args:
        function: a function at module level, so that it is compiled once.
        settings: the static arguments.
        constants: pytrees of arrays.
        x: a pytree. The function receives None in place of all leaves that are not floating-point arrays.
        y: a pytree with the shapes and dtypes of the result.
        host_map: a function of ``settings`` and ``constants``. It returns the `HostMap` for NumPy, or None if the
            compiled function takes less time.
    """
    x = eqx.filter(x, _is_inexact)
    if not is_concrete_on_cpu(constants):
        return _evaluated(function, settings, constants, x)
    fixed, of_constants = jax.tree.flatten(constants)
    leaves, of_x = jax.tree.flatten(x)
    results, of_y = jax.tree.flatten(y)
    linear_map = _Map(function, settings, host_map, of_constants, of_x, _shapes(leaves), of_y, _shapes(results))
    return jax.tree.unflatten(of_y, _linear_program.bind(*fixed, *leaves, linear_map=linear_map))


def _is_inexact(leaf: Any) -> bool:
    return jax.dtypes.issubdtype(jax.typeof(leaf).dtype, np.inexact)


def _shapes(leaves: Sequence[Any]) -> tuple[jax.ShapeDtypeStruct, ...]:
    return tuple(jax.ShapeDtypeStruct(each.shape, each.dtype) for each in map(jax.typeof, leaves))


class _Map(NamedTuple):
    """The map, or its transpose, as a function of arrays: the leaves of the constants, and those of x or y."""

    function: Callable[..., Any]
    settings: tuple[Hashable, ...]
    host_map: Callable[..., HostMap | None] | None
    of_constants: jax.tree_util.PyTreeDef
    of_x: jax.tree_util.PyTreeDef
    x: tuple[jax.ShapeDtypeStruct, ...]
    of_y: jax.tree_util.PyTreeDef
    y: tuple[jax.ShapeDtypeStruct, ...]
    transposed: bool = False

    @property
    def results(self) -> tuple[jax.ShapeDtypeStruct, ...]:
        return self.x if self.transposed else self.y

    def split(self, leaves: Sequence[Any]) -> tuple[list[Any], list[Any]]:
        """Return the leaves of the constants, and the linear inputs."""
        n = self.of_constants.num_leaves
        return list(leaves[:n]), list(leaves[n:])

    def traced(self, *leaves: Any) -> list[Any]:
        """Return the results of the traceable function or of its transpose."""
        fixed, given = self.split(leaves)
        constants = jax.tree.unflatten(self.of_constants, fixed)

        def forward(*x: Any) -> list[Any]:
            return jax.tree.leaves(
                _evaluated(self.function, self.settings, constants, jax.tree.unflatten(self.of_x, x))
            )

        return list(jax.linear_transpose(forward, *self.x)(given)) if self.transposed else forward(*given)

    def computed(self, *leaves: Any) -> list[Any]:
        """Return the results for concrete arrays, by NumPy or by one compiled program."""
        with jax.core.eval_context():
            fixed, given = self.split(leaves)
            constants, on_host = jax.tree.unflatten(self.of_constants, fixed), None
            if self.host_map is not None and is_concrete_on_cpu(given):
                on_host = self.host_map(*self.settings, *constants)
            if on_host is None:
                return _compiled(self, *leaves)
            with np.errstate(all="ignore"):
                if self.transposed:
                    y = jax.tree.unflatten(self.of_y, map(np.asarray, given))
                    result = on_host.transpose(jax.tree.unflatten(self.of_x, self.x), y)
                else:
                    result = on_host.apply(jax.tree.unflatten(self.of_x, jax.device_put(given)))
            return jax.device_put(jax.tree.leaves(result))


@partial(jax.jit, static_argnums=(0, 1))
def _evaluated(function: Callable[..., Any], settings: tuple[Hashable, ...], constants: tuple[Any, ...], x: Any) -> Any:
    return function(*settings, *constants, x)


@jit_quickly(static_argnums=0)
def _compiled(linear_map: _Map, *leaves: Any) -> list[Any]:
    return linear_map.traced(*leaves)


_linear_program = Primitive("linear_program")
_linear_program.multiple_results = True
_linear_program.def_impl(lambda *leaves, linear_map: linear_map.computed(*leaves))


@_linear_program.def_abstract_eval
def _abstract(*leaves: Any, linear_map: _Map) -> list[Any]:
    return [jax.core.ShapedArray(result.shape, result.dtype) for result in linear_map.results]


def _full(changes: Sequence[Any]) -> list[Any]:
    def full(change: Any) -> Any:
        shape: Any = change.aval if isinstance(change, ad.Zero) else None
        return change if shape is None else np.zeros(shape.shape, shape.dtype)

    return list(map(full, changes))


def _transpose(cotangents: list[Any], *leaves: Any, linear_map: _Map) -> list[Any]:
    (fixed, x), transposed = linear_map.split(leaves), linear_map._replace(transposed=not linear_map.transposed)
    results = _linear_program.bind(*fixed, *_full(cotangents), linear_map=transposed)
    wanted = map(ad.is_undefined_primal, x)
    return [None] * len(fixed) + [r if each else None for r, each in zip(results, wanted, strict=True)]


# The constants of a map are concrete, so that only x has a tangent.
def _jvp(leaves: tuple[Any, ...], changes: tuple[Any, ...], linear_map: _Map) -> tuple[list[Any], list[Any]]:
    fixed, change = linear_map.split(leaves)[0], linear_map.split(changes)[1]
    apply = partial(_linear_program.bind, linear_map=linear_map)
    return apply(*leaves), apply(*fixed, *_full(change))


def _batch(leaves: tuple[Any, ...], axes: tuple[Any, ...], linear_map: _Map) -> tuple[list[Any], list[int]]:
    results = jax.vmap(linear_map.traced, in_axes=tuple(axes))(*leaves)
    return results, [0] * len(results)


ad.primitive_transposes[_linear_program] = _transpose
ad.primitive_jvps[_linear_program] = _jvp
batching.primitive_batchers[_linear_program] = _batch
_lowered = mlir.lower_fun(lambda *leaves, linear_map: linear_map.traced(*leaves), multiple_results=True)
mlir.register_lowering(_linear_program, _lowered)
