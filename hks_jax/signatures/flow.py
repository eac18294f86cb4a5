"""Heat flow of functions on a domain and the scale space that the flow generates."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float

from hks_jax.accuracy import warn_of_accuracy
from hks_jax.arrays import nan_is_meant
from hks_jax.checks import checked_times, real_array, require_real, require_static
from hks_jax.domain.tensor_field import TensorField, require_field
from hks_jax.eigen.eigenpairs import Eigenpairs
from hks_jax.signatures.filters import Heat
from hks_jax.signatures.spectral_functions import spectral_flow
from hks_jax.signatures.times import times_of
from hks_jax.signatures.truncation import TAIL_LIMIT
from hks_jax.traced import is_traced


@nan_is_meant
def heat_flow(pairs: Eigenpairs, times: Any, functions: Any) -> Float[Array, "n_times *functions_and_shape"]:
    """Let functions diffuse on the domain: u(t) = Σᵢ exp(−λᵢt) φᵢ ∫φᵢu, the solution of ∂u/∂t = −Δu.

    The diffusion is anisotropic where the metric is. In the metric D⁻¹ the operator −Δ is not div(D∇·) where the
    determinant |D| varies; for Fick's law, make the field with ``operator="fick"``. The result is differentiable with
    respect to functions, times and tensors. The result is NaN outside the mask, and 0 at Dirichlet nodes.

    Args:
        pairs: the result of `eigenpairs`. The boundary conditions of the pairs also hold for u. Values at Dirichlet
            nodes are not used. Under ``"mirror"`` and ``"mean"`` u is reflected, so the flow is as under ``"neumann"``.
        times: (n_times,) positive, in (metric length)².
        functions: (*shape), or (…, *shape) for several functions; values outside the mask are not used.

    Raises:
        ValueError: if a time is not positive, or if a function has another shape or is not finite inside the mask.

    Warns:
        AccuracyWarning: if the part of a function beyond the k pairs exceeds 1 % of its norm at some time.

    Examples:
        >>> heat = hj.heat_flow(pairs, [0.2, 0.5], field.grid.nodes[..., 0])
        >>> [round(float((pairs.pencil.mass @ u.ravel()).sum()), 2) for u in heat]  # no heat is lost
        [1.0, 1.0]
    """
    times, shape = times_of(pairs, times), pairs.space.node_shape
    u = real_array("functions", functions).astype(times.dtype)
    if u.shape[u.ndim - len(shape) :] != shape:
        raise ValueError(f"functions: got shape {u.shape}; expected {shape}, with optional leading axes")
    if not is_traced(u):
        lacking = int((~np.isfinite(np.asarray(u))[..., pairs.space.free]).sum())
        if lacking:
            raise ValueError(f"functions: got {lacking} NaN or infinite values inside the mask; expected finite values")
    rows = jnp.where(pairs.space.domain, u, 0).reshape(-1, *shape)
    _warn_if_truncated(pairs, times, rows)
    return spectral_flow(pairs, Heat(times), rows).reshape(*times.shape, *u.shape)


def _warn_if_truncated(pairs: Eigenpairs, times: Float[Array, " n_times"], rows: Float[Array, "s *shape"]) -> None:
    pairs, times, rows = jax.lax.stop_gradient((pairs, times, rows))
    if is_traced((pairs.eigenvalues, pairs.pencil, times, rows)):
        return
    even, u = pairs.problems[0], pairs.space.restrict(rows)
    image = even.pencil.mass.apply(u)
    coefficients = jnp.matmul(image, even.vectors.T, precision="highest")
    squared = jnp.sum(u * image, axis=1)
    beyond = jnp.maximum(squared - jnp.sum(jnp.where(even.kept, coefficients**2, 0), axis=1), 0)
    share = float(jnp.max(jnp.where(squared > 0, beyond / jnp.where(squared > 0, squared, 1), 0))) ** 0.5
    rate = float(pairs.next_eigenvalue - pairs.spectral_origin)
    left = share * float(np.exp(-float(jnp.min(times)) * rate))
    if left > TAIL_LIMIT:
        enough = np.log(share / TAIL_LIMIT) / rate
        warn_of_accuracy(
            f"times: at t = {float(jnp.min(times)):.4g} up to {left:.1%} of a function's norm in the heat flow lies "
            f"beyond the computed eigenpairs. Use times of at least {enough:.4g}, or more eigenpairs",
        )


def tensor_invariants(field: TensorField) -> dict[str, Float[np.ndarray, "*shape"]]:
    """Return the ``"trace"``, ``"determinant"`` and ``"anisotropy"`` of the tensors at the nodes; NaN outside the mask.

    The anisotropy is (λ₁ − λ₂)/(λ₁ + λ₂) in 2D and the fractional anisotropy (Basser and Pierpaoli 1996) in 3D. Both
    kinds of anisotropy are below 1, and 0 for multiples of the identity.

    Args:
        field: the tensors on a grid. Pass ``TensorField(Grid(shape), T)`` for an array T (*shape, d, d). For diffusion
            tensors D, whose invariants differ from those of the metric, pass ``TensorField(grid, D)`` or
            ``from_diffusion(grid, D, "tensor")``.

    Raises:
        TypeError: if the argument is not a tensor field.
        ValueError: if the field is traced.

    Examples:
        >>> {name: round(float(values[4, 4]), 3) for name, values in hj.tensor_invariants(field).items()}
        {'trace': 5.0, 'determinant': 4.0, 'anisotropy': 0.6}
    """
    tensors = _known_tensors(field)
    d = field.grid.dimension
    trace = np.trace(tensors, axis1=-2, axis2=-1)
    deviator = tensors - trace[..., None, None] / d * np.eye(d)
    size = np.sum(np.square(deviator), axis=(-2, -1))
    scale = np.square(trace) / 2 if d == 2 else np.sum(np.square(tensors), axis=(-2, -1)) / 1.5
    scalars = {"trace": trace, "determinant": np.linalg.det(tensors), "anisotropy": np.sqrt(size / scale)}
    return {name: np.where(field.grid.inside, values, np.nan) for name, values in scalars.items()}


def _known_tensors(field: TensorField) -> Float[np.ndarray, "*shape d d"]:
    require_field(field)
    require_static("field", field)
    with jax.ensure_compile_time_eval():  # a function under jax.jit may close over the field
        return np.asarray(field.domain_tensors, np.float64)


def gaussian_scale_space(
    field: TensorField, times: Any, functions: Any
) -> Float[np.ndarray, "n_times *functions_and_shape"]:
    """Blur functions by an isotropic Gaussian of constant width, the mean width to which heat spreads in each time.

    In coordinates the standard deviation is √(2t/s), where s is the mean of |T|^(1/d) over the domain. Division by the
    blurred mask and reflection at the grid's sides preserve constants. The result is NaN outside the mask.

    Args:
        field: the metric, for its scale, its grid and its mask.
        times: (n_times,) positive, in (metric length)².
        functions: (*shape), or (…, *shape) for several functions; values outside the mask are not used.

    Raises:
        ValueError: if a time is not positive, if the functions have another shape, or if an argument is traced.

    Examples:
        >>> blurred = hj.gaussian_scale_space(field, [0.2], np.ones((9, 9)))
        >>> print(blurred.min().round(3), blurred.max().round(3))
        1.0 1.0
    """
    tensors, grid, d = _known_tensors(field), field.grid, field.grid.dimension
    for name, value in (("times", times), ("functions", functions)):
        require_static(name, value)
    require_real("functions", functions)
    with jax.ensure_compile_time_eval():
        t, u = np.asarray(checked_times(times, float)), np.asarray(functions, np.float64)
    if u.shape[u.ndim - d :] != grid.shape:
        raise ValueError(f"functions: got shape {u.shape}; expected {grid.shape}, with optional leading axes")
    inside = grid.inside
    determinant = np.linalg.det(tensors[inside])
    scale = float(np.mean(determinant ** (1 / d)))
    blurred = [_blur(np.where(inside, u, 0), inside, math.sqrt(2 * one / scale), grid.spacing) for one in t]
    return np.where(inside, np.stack(blurred), np.nan)


def _blur(u: np.ndarray, inside: np.ndarray, sigma: float, spacing: tuple[float, ...]) -> np.ndarray:
    weight = inside.astype(float)
    for axis, h in enumerate(spacing):
        # A width of three times the grid's side blurs any function to a constant; wider kernels only take longer.
        nodes = min(sigma / h, 3.0 * inside.shape[axis])
        weight = scipy.ndimage.gaussian_filter1d(weight, nodes, axis=axis, mode="mirror")
        u = scipy.ndimage.gaussian_filter1d(u, nodes, axis=axis - len(spacing), mode="mirror")
    return u / np.where(inside, weight, 1)
