"""Gaussian smoothing on grids, by a product with one small matrix along each axis."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.checks import require_number
from hks_jax.domain import spd
from hks_jax.domain.grid import Grid
from hks_jax.domain.tensor_checks import tensors_on


def smooth_tensors(grid: Grid, tensors: Any, width: float) -> Float[Array, "*shape d d"]:
    """Return the log-Euclidean mean of positive definite tensors with Gaussian weights around each node.

    The logarithms of the tensors are averaged, so the logarithm of the determinant is averaged with the same weights
    (Arsigny, Fillard, Pennec and Ayache 2006). At the boundary, the mean includes only nodes inside the mask. The
    result is differentiable, and is the identity matrix outside the mask.

    Args:
        grid: the grid of the tensors; nodes outside its mask do not contribute.
        tensors: (*shape, d, d), positive definite inside the mask.
        width: the standard deviation of the Gaussian, in coordinate units; 0 for no smoothing.

    Raises:
        ValueError: The tensors do not have the shape of the grid, or the width is negative.

    Examples:
        >>> smooth = hj.smooth_tensors(field.grid, field.tensors, width=0.2)
        >>> np.allclose(np.linalg.det(smooth), 4.0, atol=1e-3)  # no volume is made
        True
    """
    values = spd.identity_outside(tensors_on(grid, "tensors", tensors), grid.inside)
    require_number("width", width, inclusive=True)
    if width == 0:
        return values
    with jax.ensure_compile_time_eval():  # XLA takes a long time to fold these constants
        weights = [jnp.asarray(each, values.dtype) for each in gaussians(grid, width)]
        inside = jnp.asarray(grid.inside, values.dtype)[..., None, None]
        total = jnp.where(inside > 0, along_axes(weights, inside), 1)
    mean = along_axes(weights, spd.log(values) * inside) / total
    return spd.exp(jnp.where(inside > 0, mean, 0))


def gaussians(grid: Grid, width: float) -> list[Float[np.ndarray, "n n"]]:
    """Return the matrix of Gaussian weights between the nodes of each axis, with rows of Euclidean norm one."""
    matrices = []
    for n, h in zip(grid.shape, grid.spacing, strict=True):
        apart = np.subtract.outer(np.arange(n), np.arange(n)) * h
        values = np.exp(-0.5 * (apart / width) ** 2)
        matrices.append(values / np.linalg.norm(values, axis=1, keepdims=True))
    return matrices


def along_axes(matrices: list[Array], values: Float[Array, "*shape_and_more"]) -> Float[Array, "*shape_and_more"]:
    """Multiply the values by the i-th matrix along axis i, for all i."""
    for axis, matrix in enumerate(matrices):
        product = jnp.tensordot(matrix, values, axes=(1, axis), precision=jax.lax.Precision.HIGHEST)
        values = jnp.moveaxis(product, 0, axis)
    return values
