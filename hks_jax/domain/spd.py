"""Small symmetric positive definite matrices: closed forms for d = 2 and 3, batched over leading axes."""

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
