"""Functions f(A) of dense symmetric matrices, with derivatives that are exact at eigenvalues of any multiplicity."""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.linear import lapack
from hks_jax.linear.dense_eigh import checked_standard_form, transposed_solve
from hks_jax.linear.divided_differences import divided_difference, second_divided_difference
from hks_jax.linear.linear_map import linear_map, not_differentiable
from hks_jax.linear.products import matmul

Matrix = Float[Array, "n n"]
Function = Callable[[Any, Any, Array], Array]
"""f(parameters, others, x), elementwise in x. ``parameters`` has all real arrays; ``others`` has the other arrays."""


def matrix_function(A: Any, f: Callable[[Array], Any], B: Any = None) -> Float[Array, "n n"]:
    """Compute f(A) = V f(Λ) Vᵀ of a dense symmetric matrix A = VΛVᵀ, differentiably.

    If B is given, the result is V f(Λ) Vᵀ = f(B⁻¹A) B⁻¹, where AV = BVΛ and VᵀBV = I. For example, the result is B⁻¹ if
    f(λ) = 1, A⁻¹ if f(λ) = 1/λ, and the heat kernel if f(λ) = e^(−tλ).

    First and second derivatives exist with respect to A, B and the arrays in the closure of f, forward and reverse in
    any order. These derivatives are exact at equal eigenvalues, and accurate at nearly equal ones, because no division
    by a small gap occurs. `jax.vmap` over parameters of f computes eigenpairs once. Third derivatives raise an error.

    The function takes O(n³) time, mainly for the eigenpairs, and O(n²) memory; a gradient doubles the time. Second
    derivatives evaluate f'' 89 times for each of n³ triples of eigenvalues, and so suit only small matrices.

    Args:
        A: (n, n), symmetric, float32 or float64. Derivatives are with respect to the symmetric part of A.
        f: a function of JAX operations that maps one eigenvalue, a scalar, to a real scalar. f is also evaluated
            between eigenvalues. First derivatives use f', second derivatives f''. Between eigenvalues, f need not be
            smooth; so ``lambda x: x < c`` gives the projector on the eigenvectors with λ < c.
        B: (n, n), symmetric positive definite; None means the identity.

    Returns:
        The symmetric matrix f(A), (n, n). It is NaN if f returns NaN, as for the logarithm of a negative eigenvalue.

    Raises:
        ValueError: f does not return a real scalar; `eigh` refuses A or B.
        NotImplementedError: a third derivative is requested.

    Examples:
        >>> root = hj.matrix_function(jnp.array([[2.0, 1.0], [1.0, 2.0]]), jnp.sqrt)
        >>> print((root @ root).round(3))
        [[2. 1.]
         [1. 2.]]
    """
    if not callable(f) or isinstance(f, np.ufunc):
        raise TypeError(f"f: got {f!r}; expected a function of a JAX scalar, such as jnp.exp")
    a, factor = checked_standard_form(A, B)
    elementwise, parameters, others = _with_parameters(f, a)
    value = _function(elementwise, parameters, others, a)[0]
    if factor is None:
        return value
    value = transposed_solve(factor, transposed_solve(factor, value).T)
    return (value + value.T) / 2


def _with_parameters(f: Callable[[Array], Any], like: Matrix) -> tuple[Function, Any, Any]:
    """Return f as a `Function` of the real arrays in its closure, of other arrays, and of x."""
    one = jax.eval_shape(lambda a: a[0, 0], like)  # keeps the sharding type inside `shard_map`
    out = jax.eval_shape(f, one)
    if not hasattr(out, "shape") or out.shape != () or jnp.issubdtype(out.dtype, jnp.complexfloating):
        got = f"{out.dtype}{list(out.shape)}" if hasattr(out, "shape") else f"{out}"
        raise ValueError(
            f"f: returned {got} for one eigenvalue; expected a real scalar. For several functions use jax.vmap over "
            "their parameters"
        )
    closed = jax.make_jaxpr(lambda x: jnp.asarray(f(x)).astype(like.dtype))(one)
    parameters, others = eqx.partition([jnp.asarray(const) for const in closed.consts], eqx.is_inexact_array)

    def elementwise(parameters: Any, others: Any, x: Array) -> Array:
        consts = eqx.combine(parameters, others)
        return jax.vmap(lambda x: jax.core.eval_jaxpr(closed.jaxpr, consts, x)[0])(x.ravel()).reshape(x.shape)

    return elementwise, parameters, others


def _along(f: Function, parameters: Any, others: Any, change: Any) -> Callable[[Array], Array]:
    """Return the derivative of f along a change of its parameters."""
    return lambda x: jax.jvp(lambda p: f(p, others, x), (parameters,), (change,))[1]


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _function(f: Function, parameters: Any, others: Any, a: Matrix) -> tuple[Matrix, Float[Array, " n"], Matrix]:
    """Return f(A), and the eigenvalues and eigenvectors of A as constants."""
    values, vectors = lapack.eigh(a)
    return _compose(vectors, jnp.diag(f(parameters, others, values))), values, vectors


# Let A = VΛVᵀ, and let G = VᵀȦV and H = VᵀÄV for two changes Ȧ and Ä of A. The first derivative of f(A) along Ȧ and the
# second derivative along Ȧ and Ä are (Daleckii and Krein 1965)
#
#     ḟ(A) = V ([f]∘G) Vᵀ,    [f]ᵢⱼ = f[λᵢ, λⱼ],
#     f̈(A) = V S Vᵀ,    Sᵢₖ = Σⱼ f[λᵢ, λⱼ, λₖ] (Gᵢⱼ Hⱼₖ + Hᵢⱼ Gⱼₖ),
#
# where ∘ is the elementwise product, and the divided differences f[…] are smooth at equal eigenvalues. Neither
# derivative depends on the chosen basis of an eigenspace. At a multiple eigenvalue, Λ and V have no derivatives, so
# that differentiating the formula of ḟ(A) term by term would not give f̈(A). First and second derivatives therefore
# have separate rules, with eigenpairs as constants.
#
# If f has derivatives ∂f and ∂'f along two changes of its parameters, the first and the second derivative of f(A) are
#
#     V ([f]∘G + ∂f(Λ)) Vᵀ    and    V (S + [∂f]∘H + [∂'f]∘G + ∂∂'f(Λ)) Vᵀ.
@_function.defjvp
def _function_jvp(f: Function, primals: tuple, tangents: tuple) -> tuple[tuple, tuple]:
    (parameters, others, a), (d_parameters, _, d_a) = primals, tangents
    value, values, vectors = _function(f, parameters, others, a)
    table = _table(partial(f, parameters, others), values)
    constants, change = (others, values, vectors, jax.lax.stop_gradient(table)), (d_parameters, d_a)
    tangent = linear_map(partial(_first, f), partial(_second, f), (parameters, a), constants, change)
    return (value, values, vectors), (tangent, jnp.zeros_like(values), jnp.zeros_like(vectors))


_THIRD = "third derivatives of matrix functions are not implemented; only first and second derivatives are"


def _first(f: Function, at: Any, constants: Any, change: Any) -> Matrix:
    """Return the derivative of f(A) along a joint change of A and of the parameters of f."""
    (parameters, _), (others, values, vectors, table) = not_differentiable(_THIRD, at), constants
    d_parameters, d_a = change
    along = _along(f, parameters, others, d_parameters)
    return _compose(vectors, table * matmul(vectors.T, d_a, vectors) + jnp.diag(along(values)))


def _second(f: Function, at: Any, one: Any, constants: Any, two: Any) -> Matrix:
    """Return the second derivative of f(A) along two joint changes of A and of the parameters of f."""
    (parameters, _), (others, values, vectors, table) = not_differentiable(_THIRD, at), constants
    (d_one, a_one), (d_two, a_two) = one, two
    g, h = matmul(vectors.T, a_one, vectors), matmul(vectors.T, a_two, vectors)
    along_one, along_two = (_table_along(f, parameters, others, values, d) for d in (d_one, d_two))
    both = jax.jvp(lambda p: _along(f, p, others, d_one)(values), (parameters,), (d_two,))[1]
    inner = along_one * h + along_two * g + jnp.diag(both)
    return _compose(vectors, inner + _mixed(partial(f, parameters, others), values, table, g, h))


def _table(f: Callable[[Array], Array], values: Float[Array, " n"]) -> Matrix:
    """Return the matrix [f] of divided differences of all pairs of eigenvalues."""
    a, b = values[:, None], values[None]
    return divided_difference(f, jnp.minimum(a, b), jnp.maximum(a, b))


def _table_along(f: Function, parameters: Any, others: Any, values: Float[Array, " n"], change: Any) -> Matrix:
    """Return the derivative of `_table` along a change of the parameters of f; it is linear in this change."""
    return jax.jvp(lambda p: _table(partial(f, p, others), values), (parameters,), (change,))[1]


def _mixed(f: Callable[[Array], Array], values: Float[Array, " n"], table: Matrix, g: Matrix, h: Matrix) -> Matrix:
    """Return Σⱼ f[λᵢ, λⱼ, λₖ] (Gᵢⱼ Hⱼₖ + Hᵢⱼ Gⱼₖ)."""
    n, scale = len(values), jnp.max(jnp.abs(table))
    i, k = jnp.arange(n)[:, None], jnp.arange(n)

    @jax.checkpoint  # reverse mode would otherwise store n³ numbers
    def add(total: Matrix, j: Array) -> tuple[Matrix, None]:
        low, high = jnp.minimum(jnp.minimum(i, k), j), jnp.maximum(jnp.maximum(i, k), j)
        middle = i + j + k - low - high
        below, above = table[low, middle], table[middle, high]
        weights = second_divided_difference(f, values[low], values[middle], values[high], below, above, scale)
        return total + weights * (jnp.outer(g[:, j], h[j]) + jnp.outer(h[:, j], g[j])), None

    return jax.lax.scan(add, jnp.zeros_like(g), jnp.arange(n))[0]


def _compose(vectors: Matrix, inner: Matrix) -> Matrix:
    """Return the symmetric part of V X Vᵀ, where V are the eigenvectors and X is ``inner``."""
    full = matmul(vectors, inner, vectors.T)
    return (full + full.T) / 2
