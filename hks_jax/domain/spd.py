"""Small symmetric positive definite matrices: d = 2 and 3, batched over leading axes."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


def symmetrise(tensors: Float[Array, "... d d"]) -> Float[Array, "... d d"]:
    """Return the symmetric part, ``(T + Tᵀ)/2``."""
    return 0.5 * (tensors + jnp.swapaxes(tensors, -1, -2))


def adjugate(tensors: Float[Array, "... d d"]) -> Float[Array, "... d d"]:
    """Return the adjugate ``|T| T⁻¹`` of symmetric matrices, d = 2 or 3."""
    t = tensors
    if t.shape[-1] == 2:
        rows = [[t[..., 1, 1], -t[..., 0, 1]], [-t[..., 1, 0], t[..., 0, 0]]]
    else:

        def cofactor(i: int, j: int) -> Array:
            (a, b), (c, d) = ((i + 1) % 3, (i + 2) % 3), ((j + 1) % 3, (j + 2) % 3)
            return t[..., a, c] * t[..., b, d] - t[..., a, d] * t[..., b, c]

        rows = [[cofactor(j, i) for j in range(3)] for i in range(3)]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def determinant(tensors: Float[Array, "... d d"]) -> Float[Array, "..."]:
    """Return the determinant |T|, d = 2 or 3."""
    t = tensors
    if t.shape[-1] == 2:
        return t[..., 0, 0] * t[..., 1, 1] - t[..., 0, 1] * t[..., 1, 0]
    return jnp.sum(t[..., 0, :] * adjugate(t)[..., :, 0], axis=-1)


def inverse(tensors: Float[Array, "... d d"]) -> Float[Array, "... d d"]:
    """Return T⁻¹, d = 2 or 3."""
    return adjugate(tensors) / determinant(tensors)[..., None, None]


def is_spd(tensors: np.ndarray) -> np.ndarray:
    """Tell, by Sylvester's criterion, which matrices (..., d, d) are finite and positive definite (on the host)."""
    t = np.asarray(tensors, dtype=np.float64)
    finite = np.isfinite(t).all(axis=(-2, -1), keepdims=True)
    t = np.where(finite, t, 0.0)
    minors = [np.linalg.det(t[..., :m, :m]) > 0 for m in range(1, t.shape[-1] + 1)]
    return np.logical_and.reduce(minors)


def exp(tensors: Float[Array, "... d d"]) -> Float[Array, "... d d"]:
    """Return the exponential of symmetric matrices."""
    return _spectral("exp", tensors)


def log(tensors: Float[Array, "... d d"]) -> Float[Array, "... d d"]:
    """Return the logarithm of symmetric positive definite matrices."""
    return _spectral("log", tensors)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _spectral(name: str, tensors: Float[Array, "... d d"]) -> Float[Array, "... d d"]:
    values, vectors = jnp.linalg.eigh(tensors)
    return _compose(vectors, getattr(jnp, name)(values)[..., None] * jnp.eye(values.shape[-1], dtype=values.dtype))


# d f(T) = V ([f]∘(Vᵀ dT V)) Vᵀ with the divided differences of f (Daleckii and Krein 1965), which are smooth where
# eigenvalues meet; the derivatives of the eigenvectors are not.
@_spectral.defjvp
def _spectral_jvp(name: str, primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    values, vectors = jnp.linalg.eigh(primals[0])
    a, b = values[..., :, None], values[..., None, :]
    half = (a - b) / 2
    if name == "exp":
        differences = jnp.exp((a + b) / 2) * _sinhc(half)
    else:
        ratio = half / ((a + b) / 2)
        differences = 2 / (a + b) * _atanhc(ratio)
    inner = _matmul(_matmul(jnp.swapaxes(vectors, -1, -2), tangents[0]), vectors)
    return _spectral(name, primals[0]), _compose(vectors, differences * inner)


def _compose(vectors: Float[Array, "... d d"], inner: Float[Array, "... d d"]) -> Float[Array, "... d d"]:
    return symmetrise(_matmul(_matmul(vectors, inner), jnp.swapaxes(vectors, -1, -2)))


def _matmul(a: Float[Array, "... d d"], b: Float[Array, "... d d"]) -> Float[Array, "... d d"]:
    return jnp.matmul(a, b, precision="highest")


def _sinhc(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return sinh(x)/x."""
    small = jnp.abs(x) < 1e-2
    return jnp.where(small, 1 + x**2 / 6 + x**4 / 120, jnp.sinh(x) / jnp.where(small, 1, x))


def _atanhc(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return atanh(x)/x."""
    small = jnp.abs(x) < 1e-2
    return jnp.where(small, 1 + x**2 / 3 + x**4 / 5 + x**6 / 7, jnp.arctanh(x) / jnp.where(small, 1, x))
