"""Building blocks of derivative rules: linear maps with custom rules, which allow second derivatives in any order.

`not_differentiable` and `first_order_only` raise an error if differentiating a rule again would give wrong numbers.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NoReturn, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero

LinearMap = Callable[[Any, Any, Any], Any]
"""f(at, constants, x), linear in x; all arguments are pytrees of arrays."""
Derivative = Callable[[Any, Any, Any, Any], Any]
"""f(at, change of at, constants, x), bilinear in the change and in x."""
Tree = TypeVar("Tree")


# In reverse mode, JAX replaces a function with a custom rule by the function's body if the function is linear in an
# unknown tangent. An outer derivative then differentiates the body instead of the rule. JAX never replaces a linear
# solve by its body, so a linear map F is applied by solving a symmetric linear system:
#
#     ⎡ 0   I ⎤ ⎡u⎤   ⎡b⎤                  ⎡ 0   F ⎤
#     ⎣ I  −S ⎦ ⎣v⎦ = ⎣c⎦,    where    S = ⎣ Fᵀ  0 ⎦.
#
# The solution is v = b, u = c + S b; if b = (0, x) and c = 0, the unknown u contains F x. Derivatives of the solution
# need those of products with S, which have a custom rule. Since S is symmetric, reverse mode solves the same system.
def linear_map(function: LinearMap, derivative: Derivative, at: Any, constants: Any, x: Any) -> Any:
    """Return ``function(at, constants, x)``; its derivative with respect to ``at`` is computed by ``derivative``.

    Forward and reverse mode can be combined in any order. Derivatives with respect to ``constants`` are zero.
    """

    x = jax.tree.map(jnp.asarray, x)  # a user's tangents may be Python numbers
    like = jax.tree.map(jnp.zeros_like, x)
    forward = partial(_forward, function, derivative, at, constants)
    return with_transpose(forward, partial(_backward, function, derivative, at, constants, like), x, at)


def with_transpose(forward: Callable[[Any], Any], backward: Callable[[Any], Any], x: Any, at: Any = ()) -> Any:
    """Return y = ``forward(x)``, linear in x, whose transpose is ``backward``; JAX transposes neither function.

    Both x and y are pytrees of floating-point arrays. ``at`` contains all other variables of ``forward`` and
    ``backward``; derivatives of these functions with respect to ``at`` have custom rules.
    """

    # JAX transposes a solve only if every part of its right-hand side depends on variables, as these zeros formally do.
    def zeros(like: Any, tree: Any) -> Any:
        empty = [jnp.ravel(jnp.atleast_1d(leaf)[:0]).astype(float) for leaf in jax.tree.leaves(tree)]
        nothing = jnp.sum(jnp.concatenate([jnp.zeros(0), *empty]))
        return jax.tree.map(lambda leaf: jnp.full(leaf.shape, nothing, leaf.dtype), like)

    def swap(y: Any, x: Any) -> tuple[Any, Any]:
        return forward(x), backward(y)

    def system(unknowns: tuple[Any, Any]) -> tuple[Any, Any]:
        u, v = unknowns
        return jax.tree.map(jnp.add, v, zeros(v, at)), jax.tree.map(jnp.subtract, u, swap(*v))

    def solve(_: Any, right: tuple[Any, Any]) -> tuple[Any, Any]:
        b, c = right
        return jax.tree.map(jnp.add, c, swap(*b)), b

    y = zeros(jax.eval_shape(forward, x), x)
    right = (y, jax.tree.map(jnp.add, x, zeros(x, x))), (y, zeros(x, x))
    (result, rest), others = jax.lax.custom_linear_solve(system, right, solve, symmetric=True)
    # JAX differentiates a transposed solve only if all parts of the solution have cotangents, so the result uses all.
    return jax.tree.map(jnp.add, result, zeros(result, (rest, others)))


@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _forward(function: LinearMap, derivative: Derivative, at: Any, constants: Any, x: Any) -> Any:
    return function(at, constants, x)


@_forward.defjvp
def _forward_jvp(function: LinearMap, derivative: Derivative, primals: tuple, tangents: tuple) -> tuple[Any, Any]:
    (at, constants, x), (change, _, d_x) = primals, tangents
    tangent = jax.tree.map(jnp.add, derivative(at, change, constants, x), function(at, constants, d_x))
    return _forward(function, derivative, at, constants, x), tangent


@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _backward(function: LinearMap, derivative: Derivative, at: Any, constants: Any, like: Any, y: Any) -> Any:
    """Return the transpose applied to y; ``like`` has the structure of x."""
    return jax.linear_transpose(partial(function, at, constants), like)(y)[0]


@_backward.defjvp
def _backward_jvp(function: LinearMap, derivative: Derivative, primals: tuple, tangents: tuple) -> tuple[Any, Any]:
    (at, constants, like, y), (change, _, _, d_y) = primals, tangents
    (of_derivative,) = jax.linear_transpose(partial(derivative, at, change, constants), like)(y)
    (of_function,) = jax.linear_transpose(partial(function, at, constants), like)(d_y)
    tangent = jax.tree.map(jnp.add, of_derivative, of_function)
    return _backward(function, derivative, at, constants, like, y), tangent


def is_constant(changes: Any) -> bool:
    """Return whether all leaves of a rule's tangents are symbolic zeros."""
    return all(_is_zero(leaf) for leaf in jax.tree.leaves(changes, is_leaf=_is_zero))


def instantiated(changes: Any) -> Any:
    """Return a rule's tangents with arrays in place of symbolic zeros."""

    def full(leaf: Any) -> Any:  # a single zero in memory, so that programs have no large constants
        return np.broadcast_to(np.zeros((), leaf.dtype), leaf.shape) if _is_zero(leaf) else leaf

    return jax.tree.map(full, changes, is_leaf=_is_zero)


def _is_zero(leaf: Any) -> bool:
    return isinstance(leaf, SymbolicZero)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def not_differentiable(message: str, tree: Tree) -> Tree:
    """Return ``tree`` unchanged; differentiating it raises NotImplementedError with this message."""
    return tree


@not_differentiable.defjvp
def _refuse(message: str, primals: tuple, tangents: tuple) -> NoReturn:
    raise NotImplementedError(message)


_MESSAGE = (
    "second derivatives of eigenpairs and of their signatures with respect to the tensors, the vertices or the "
    "pencil are not implemented. First derivatives are implemented, and so are their derivatives with respect to "
    "times and other filter parameters (in the opposite order of derivatives, use jax.jvp for the inner one). For a "
    "Hessian use Gauss-Newton products, jax.vjp after jax.jvp of the signature, or central differences of jax.grad"
)


def first_order_only(tree: Tree) -> Tree:
    """Return ``tree`` unchanged; differentiating it raises NotImplementedError.

    The derivative rules of eigenpairs and spectral functions are valid only at eigenpairs. First derivatives do not
    determine how eigenvectors rotate within the eigenspace of a multiple eigenvalue. Differentiating the derivative
    rules would therefore give wrong second derivatives, so that an error is raised instead.
    """
    return not_differentiable(_MESSAGE, tree)
