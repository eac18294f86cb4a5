"""Functions of small symmetric positive definite matrices (..., d, d), where d is 2 or 3."""

import math
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hks_jax.compilation import library_of, numpy_where_known
from hks_jax.linear.dense_eigh import differentiable_eigh
from hks_jax.linear.products import matmul


@numpy_where_known()
def symmetrise(tensors: Any) -> Any:
    """Return the symmetric part, ``(T + Tᵀ)/2``."""
    return 0.5 * (tensors + tensors.mT)


def identity_outside(
    tensors: Float[Array, "*shape d d"], inside: Bool[np.ndarray | Array, "*shape"]
) -> Float[Array, "*shape d d"]:
    """Return the tensors inside the mask, and the identity at nodes outside the mask."""
    return tensors if isinstance(inside, np.ndarray) and inside.all() else _identity_outside(tensors, inside)


@numpy_where_known()
def _identity_outside(tensors: Any, inside: Any) -> Any:
    xp = library_of(tensors)
    return xp.where(inside[..., None, None], tensors, xp.eye(tensors.shape[-1], dtype=tensors.dtype))


def adjugate(tensors: Any) -> Any:
    """Return the adjugate ``|T| T⁻¹`` of symmetric matrices (..., d, d), d = 2 or 3, in JAX or NumPy."""
    t = tensors
    if t.shape[-1] == 2:
        rows = [[t[..., 1, 1], -t[..., 0, 1]], [-t[..., 1, 0], t[..., 0, 0]]]
    else:

        def cofactor(i: int, j: int) -> Any:
            (a, b), (c, d) = ((i + 1) % 3, (i + 2) % 3), ((j + 1) % 3, (j + 2) % 3)
            return t[..., a, c] * t[..., b, d] - t[..., a, d] * t[..., b, c]

        rows = [[cofactor(j, i) for j in range(3)] for i in range(3)]
    xp = library_of(t)
    return xp.stack([xp.stack(row, axis=-1) for row in rows], axis=-2)


def determinant(tensors: Any) -> Any:
    """Return the determinants |T| of matrices (..., d, d), d = 2 or 3, in JAX or NumPy."""
    t = tensors
    if t.shape[-1] == 2:
        return t[..., 0, 0] * t[..., 1, 1] - t[..., 0, 1] * t[..., 1, 0]
    return (t[..., 0, :] * adjugate(t)[..., :, 0]).sum(-1)


def inverse(tensors: Any) -> Any:
    """Return T⁻¹ of matrices (..., d, d), d = 2 or 3, in JAX or NumPy."""
    return adjugate(tensors) / determinant(tensors)[..., None, None]


def metric_of_diffusion(tensors: Any, metric: str) -> Any:
    """Return the metric ``"inverse"`` (D⁻¹), ``"adjugate"`` (|D| D⁻¹) or ``"tensor"`` (D) in JAX or NumPy."""
    return tensors if metric == "tensor" else inverse(tensors) if metric == "inverse" else adjugate(tensors)


def cholesky(tensors: Float[Array, "... d d"], negligible: float | None = None) -> Float[Array, "... d d"]:
    """Return the lower triangular L with T = LLᵀ; NaN for matrices that are not positive definite.

    For positive semidefinite T pass ``negligible``: column j of L is zero if its pivot is at most ``negligible`` · Tⱼⱼ.
    """
    factor = jnp.zeros_like(tensors)
    for j in range(tensors.shape[-1]):
        column = tensors[..., j] - jnp.sum(factor * factor[..., j, None, :], axis=-1)
        pivot = column[..., j, None]
        zero = False if negligible is None else pivot <= negligible * tensors[..., j, j, None]
        column = jnp.where(zero, 0, column) / jnp.sqrt(jnp.where(zero, 1, pivot))
        factor = factor.at[..., j:, j].set(column[..., j:])
    return factor


def is_spd(tensors: np.ndarray) -> np.ndarray:
    """Mark the matrices (..., d, d) that are finite and positive definite (Sylvester's criterion, on the host)."""
    t = np.asarray(tensors, dtype=np.float64)
    finite = np.isfinite(t).all(axis=(-2, -1), keepdims=True)
    with np.errstate(over="ignore", invalid="ignore"):
        return is_positive(np.where(finite, t, 0.0))


def is_positive(t: Any) -> Any:
    """Mark the matrices (..., d, d) of JAX or NumPy that are positive definite, by Sylvester's criterion."""
    return (t[..., 0, 0] > 0) & (determinant(t[..., :2, :2]) > 0) & (determinant(t) > 0)


# A product with NaN, unlike `where(…)`, makes the derivatives of invalid matrices NaN, too; `where(…)` makes them zero.
def nan_unless(valid: Any, matrices: Any) -> Any:
    """Return the matrices (..., i, j) of JAX or NumPy, with NaN in place of matrices that are not ``valid``."""
    xp = library_of(matrices)
    return matrices * xp.where(valid, 1, xp.nan).astype(matrices.dtype)[..., None, None]


def nan_unless_positive(tensors: Any) -> Any:
    """Return the matrices of JAX or NumPy, d = 2 or 3, with NaN in place of those that are not positive definite."""
    return nan_unless(is_positive(tensors), tensors)


positive_or_nan = numpy_where_known()(nan_unless_positive)


# Let S be a matrix of trace zero. By the Cayley–Hamilton theorem S² = qI with a number q (d = 2), or S³ = pS + |S| I
# with a number p (d = 3). So exp S is a polynomial in S of degree d − 1, whose coefficients are entire functions of the
# number q, or of p and the determinant |S|. No eigenvalues are needed, and derivatives of any order are smooth where
# eigenvalues coincide. Taylor's series gives the coefficients of the matrix E = exp(S/2ⁿ) − I. Replacing the matrix E
# by 2E + E² doubles its exponent, and keeps the relative accuracy of E; n replacements give exp S − I.
_SQUARINGS, _TERMS = 8, 20


@jax.jit
@jax.checkpoint  # reverse mode stores only the given matrices, not a hundred intermediate results for each of them
def exp(tensors: Float[Array, "... d d"]) -> Float[Array, "... d d"]:
    """Return the exponential of symmetric matrices, d = 2 or 3."""
    d, tensors = tensors.shape[-1], symmetrise(tensors)
    eye = jnp.broadcast_to(jnp.eye(d, dtype=tensors.dtype), tensors.shape)
    mean = jnp.trace(tensors, axis1=-2, axis2=-1) / d
    deviator = tensors - mean[..., None, None] * eye
    powers, coefficients = (_exp_in_2d if d == 2 else _exp_in_3d)(deviator)
    total = eye + sum(c[..., None, None] * power for c, power in zip(coefficients, (eye, *powers), strict=True))
    return jnp.exp(mean)[..., None, None] * total


def _exp_in_2d(deviator: Float[Array, "... 2 2"]) -> tuple[list[Array], list[Array]]:
    """Return the list [S], and the coefficients of I and S in the polynomial exp S − I, for S of trace zero."""
    q = jnp.square(deviator[..., 0, 0]) + jnp.square(deviator[..., 0, 1])
    small = q / 4**_SQUARINGS
    a = b = jnp.zeros_like(q)
    for n in range(_TERMS // 2, 0, -1):  # Horner's scheme
        a = small * (a + 1 / math.factorial(2 * n))
        b = small * (b + 1 / math.factorial(2 * n + 1))
    b = (1 + b) / 2**_SQUARINGS
    for _ in range(_SQUARINGS):
        a, b = 2 * a + a * a + b * b * q, 2 * b * (1 + a)
    return [deviator], [a, b]


def _exp_in_3d(deviator: Float[Array, "... 3 3"]) -> tuple[list[Array], list[Array]]:
    """Return the list [S, S²], and the coefficients of I, S and S² in the polynomial exp S − I, for S of trace zero."""
    square = matmul(deviator, deviator)
    p, r = 0.5 * jnp.trace(square, axis1=-2, axis2=-1), determinant(deviator)
    small_p, small_r = p / 4**_SQUARINGS, r / 8**_SQUARINGS
    a = b = c = jnp.zeros_like(p)
    for n in range(_TERMS, 0, -1):  # Horner's scheme: x ↦ S (1/n! + x), S³ = pS + rI
        a, b, c = c * small_r, a + 1 / math.factorial(n) + c * small_p, b
    b, c = b / 2**_SQUARINGS, c / 4**_SQUARINGS
    for _ in range(_SQUARINGS):  # S³ = pS + rI, S⁴ = pS² + rS
        a, b, c = (
            2 * a + a * a + 2 * b * c * r,
            2 * b + 2 * a * b + 2 * b * c * p + c * c * r,
            2 * c + b * b + 2 * a * c + c * c * p,
        )
    return [deviator, square], [a, b, c]


@jax.jit
def log(tensors: Float[Array, "... d d"]) -> Float[Array, "... d d"]:
    """Return the logarithm of symmetric positive definite matrices, d = 2 or 3; NaN for other matrices."""
    symmetric = symmetrise(tensors)
    return _log_in_2d(symmetric) if tensors.shape[-1] == 2 else _log_by_eigenvalues(symmetric)


# Let the matrix T be mI + S with a number m and a matrix S of trace zero. Then S² = qI with a number q, and the
# eigenvalues of T are m ± √q. So log T = ½ log|T| I + atanh(√q/m)/√q S, where atanh(x)/x is a smooth function of x².
def _log_in_2d(tensors: Float[Array, "... 2 2"]) -> Float[Array, "... 2 2"]:
    eye = jnp.broadcast_to(jnp.eye(2, dtype=tensors.dtype), tensors.shape)
    mean = jnp.trace(tensors, axis1=-2, axis2=-1) / 2
    scaled = tensors / mean[..., None, None]
    deviator = scaled - eye
    square = jnp.square(deviator[..., 0, 0]) + jnp.square(deviator[..., 0, 1])
    half = 0.5 * jnp.log(determinant(scaled))
    small = square < 0.04
    series = jnp.zeros_like(square)
    for n in range(12, -1, -1):
        series = series * jnp.where(small, square, 0) + 1 / (2 * n + 1)
    root = jnp.sqrt(jnp.where(small, 0.04, square))
    # For x = √q/m, atanh x is log(1 + x) − ½ log(1 − x²), where |T/m| = 1 − x² is accurate near zero, too.
    factor = jnp.where(small, series, (jnp.log1p(root) - half) / root)
    return (jnp.log(mean) + half)[..., None, None] * eye + factor[..., None, None] * deviator


@jax.custom_jvp
def _log_by_eigenvalues(tensors: Float[Array, "... d d"]) -> Float[Array, "... d d"]:
    values, vectors = eigh(tensors)
    return _log_of_pairs(values, vectors)


# The derivative of f(T) is V ([f]∘(Vᵀ dT V)) Vᵀ with the eigenvectors V of T and the divided differences [f] of f
# (Daleckii and Krein 1965). Where eigenvalues coincide, [f] is smooth, whereas the derivatives of V are not.
@_log_by_eigenvalues.defjvp
def _log_by_eigenvalues_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    values, vectors = eigh(primals[0])
    a, b = values[..., :, None], values[..., None, :]
    x = (a - b) / (a + b)
    small = jnp.abs(x) < 1e-2
    atanhc = jnp.where(small, 1 + x**2 / 3 + x**4 / 5 + x**6 / 7, jnp.arctanh(x) / jnp.where(small, 1, x))  # atanh(x)/x
    differences = 2 / (a + b) * atanhc
    inner = matmul(jnp.swapaxes(vectors, -1, -2), tangents[0], vectors)
    return _log_of_pairs(values, vectors), _compose(vectors, differences * inner)


def eigh(tensors: Float[Array, "... d d"]) -> tuple[Float[Array, "... d"], Float[Array, "... d d"]]:
    """Return the eigenvalues of symmetric matrices, ascending, and orthonormal eigenvectors in columns."""
    return jnp.vectorize(partial(differentiable_eigh, None), signature="(d,d)->(d),(d,d)")(tensors)


def _log_of_pairs(values: Float[Array, "... d"], vectors: Float[Array, "... d d"]) -> Float[Array, "... d d"]:
    identity = jnp.broadcast_to(jnp.eye(values.shape[-1], dtype=values.dtype), vectors.shape)
    return _compose(vectors, jnp.log(values)[..., None] * identity)


def _compose(vectors: Float[Array, "... d d"], inner: Float[Array, "... d d"]) -> Float[Array, "... d d"]:
    return symmetrise(matmul(vectors, inner, jnp.swapaxes(vectors, -1, -2)))
