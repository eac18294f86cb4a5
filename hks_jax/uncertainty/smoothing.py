"""Gaussian smoothing on grids, as products with one small matrix along each axis."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.checks import real_array, require_number
from hks_jax.domain import spd
from hks_jax.domain.grid import Grid


def smooth_tensors(grid: Grid, tensors: Any, width: float) -> Float[Array, "*shape d d"]:
    """Smooth positive definite tensors by a Gaussian, log-Euclidean: the weighted mean of their logarithms.

    The determinant's logarithm is smoothed likewise, so that smoothing makes no volume (Arsigny, Fillard, Pennec and
    Ayache 2006). At sides and at the rim of the mask the mean is that of the nodes inside.

    Args:
        grid: the grid, whose mask is kept.
        tensors: (*shape, d, d), positive definite inside the mask.
        width: the standard deviation of the Gaussian, in coordinate units; 0 for none.

    Returns:
        (*shape, d, d); the identity outside the mask. Differentiable.

    Raises:
        ValueError: tensors that do not fit the grid; a negative width.
    """
    d, values = grid.dimension, real_array("tensors", tensors)
    if values.shape != (*grid.shape, d, d):
        raise ValueError(f"tensors: got shape {values.shape}; expected (*grid.shape, d, d) = {(*grid.shape, d, d)}")
    require_number("width", width, inclusive=True)
    if width == 0:
        return values
    with jax.ensure_compile_time_eval():  # XLA folds these constants slowly
        weights = [jnp.asarray(each, values.dtype) for each in gaussians(grid, width)]
        inside = jnp.asarray(grid.inside, values.dtype)[..., None, None]
        total = jnp.where(inside > 0, along_axes(weights, inside), 1)
    mean = along_axes(weights, spd.log(spd.identity_outside(values, grid.inside)) * inside) / total
    return spd.exp(jnp.where(inside > 0, mean, 0))


def gaussians(grid: Grid, width: float) -> list[Float[np.ndarray, "n n"]]:
    """Return for each axis the matrix of a Gaussian's values between its nodes, its rows' squares adding up to one."""
    matrices = []
    for n, h in zip(grid.shape, grid.spacing, strict=True):
        apart = np.subtract.outer(np.arange(n), np.arange(n)) * h
        values = np.exp(-0.5 * (apart / width) ** 2)
        matrices.append(values / np.linalg.norm(values, axis=1, keepdims=True))
    return matrices


def along_axes(matrices: list[Array], values: Float[Array, "*shape_and_more"]) -> Float[Array, "*shape_and_more"]:
    """Multiply by a matrix along each of the first axes."""
    for axis, matrix in enumerate(matrices):
        product = jnp.tensordot(matrix, values, axes=(1, axis), precision=jax.lax.Precision.HIGHEST)
        values = jnp.moveaxis(product, 0, axis)
    return values
