"""Warnings where noise or rounding of nodal tensors dominates their derivatives, or the grid does not resolve them."""

from collections.abc import Callable, Sequence
from math import comb

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.accuracy import warn_of_accuracy
from hks_jax.curvature.stencils import centred_nodes
from hks_jax.domain.grid import Grid
from hks_jax.domain.tensor_field import TensorField
from hks_jax.traced import is_traced

_FLAT = 0.5
"""The least ratio of the roughness in differences of the order n to that of the order n − 2, if noise dominates both.

White noise has the same roughness in all orders; the roughness of a resolved smooth field falls with the order."""
_NORMAL = 1.4826
"""The ratio of the standard deviation of a normal variable with mean zero to the median of its absolute value."""
_SHARE = 0.5
"""The least ratio of the noise to the median size of a quantity at which noise dominates the quantity."""
_UNRESOLVED, _NODES = 0.25, 0.02
"""The error of the differences, relative to the median size of a quantity, that matters at more than this share of the
nodes."""
_NEAR_SIDES = 1 / 2
"""The ratio of the error to its estimate where rows are shifted: their polynomials have degrees 4, 3 and 2, so the
series is short. Measured were 1/4 (sphere) to 1 (hyperbolic plane), for 21 to 81 nodes per axis."""
_ABOVE = 5
"""The ratio to the noise above which a change by the order of the differences counts as an error of truncation."""
_ROUNDING = 100
"""The noise, in machine precisions of the tensors, below which it is called rounding."""


def warn_of_errors(
    field: TensorField,
    compute: Callable[[TensorField, int], Sequence[Array]],
    values: Sequence[Array],
    names: Sequence[str],
    negligible: Sequence[float],
    wraps: tuple[bool, ...],
    differences: int = 6,
) -> None:
    """Warn about the first of several quantities at the nodes that is dominated by noise of the tensors, or unresolved.

    The noise of a quantity is the median size of its change if noise of the estimated level is added to the tensors.
    With differences of three orders of accuracy, the quantity changes by d₁ from the highest to the second, and by d₂
    from there to the lowest. Its error of truncation is about d₁ · d₁/d₂, as in a geometric series, and at most d₁.

    Args:
        field: the metric; nothing is done for a function, or if it is traced.
        compute: returns the quantities of a field, by differences whose order is lower by 0, 1 or 2 steps.
        values: the quantities of `field`.
        names: the names of the quantities.
        negligible: the noise of each quantity that does not matter; at least 1/V^(2/d) counts as such for the first,
            the curvature, since smaller curvatures change nothing in a domain of the volume V.
        wraps: whether each axis is periodic.
        differences: the order of the differences that show the noise. It must exceed the order of the derivatives.
    """
    field, values = jax.lax.stop_gradient((field, list(values)))
    if field.function is not None or is_traced((field, values)):
        return
    tensors = np.asarray(field.domain_tensors)
    precision, d = float(np.finfo(tensors.dtype).eps), field.grid.dimension
    high, low = (_roughness(tensors.astype(np.float64), field.grid, n) for n in (differences, differences - 2))
    level = max(high if high > _FLAT * low else 0.0, precision)
    inside = field.grid.inside
    density = np.sqrt(np.abs(np.linalg.det(tensors[inside].astype(np.float64))))
    floor = float(np.sum(density) * np.prod(field.grid.spacing)) ** (-2 / d)
    white = np.random.default_rng(0).normal(size=tensors.shape)
    noise = level * (white + np.swapaxes(white, -1, -2)) / 2 * _mean(tensors)[..., None, None]
    noisy = eqx.tree_at(lambda f: f._tensors, field, jnp.asarray(tensors + noise.astype(tensors.dtype)))
    noises = []
    for name, value, other, least in zip(names, values, compute(noisy, 0), negligible, strict=True):
        change_at, size_at = np.abs(np.asarray(other - value, np.float64)), np.abs(np.asarray(value, np.float64))
        known = np.isfinite(change_at)
        if not known.any():
            noises.append(0.0)
            continue
        size, change = np.median(size_at[known]), np.median(change_at[known])
        noises.append(float(change))
        if change <= max(least or floor, _SHARE * size):
            continue
        told = f"the {name} has an error of about {change:.2g} by "
        if level < _ROUNDING * precision:
            warn_of_accuracy(
                f"{told}rounding of the tensors in {tensors.dtype}, and a median size of {size:.2g}: the error grows "
                "with refinement. Use float64, a coarser grid (such as every second node), a lower order, or a metric "
                "from TensorField.from_function"
            )
        else:
            warn_of_accuracy(
                f"{told}noise of the tensors, and a median size of {size:.2g}: noise dominates. By differences of "
                f"nodes, the noise is {level:.2g} of the mean eigenvalue. Smooth the tensors, for example by hks_jax."
                "smooth_tensors(grid, tensors, width) with a width of some node distances, and compute error bars with "
                "hks_jax.uncertainty"
            )
        return
    of_orders = [values, *(compute(field, lower) for lower in (1, 2))]
    for name, least, noise_of, *of_each in zip(names, negligible, noises, *of_orders, strict=True):
        found = np.asarray(of_each, np.float64)
        resolved = np.isfinite(found).all(axis=0)
        if not resolved.any():
            continue
        high, middle, low = (each[resolved] for each in found)
        first, second = np.abs(high - middle), np.abs(middle - low)
        error = first * np.minimum(first / np.maximum(second, np.finfo(float).tiny), 1)
        error = np.where(centred_nodes(inside, wraps)[resolved], error, _NEAR_SIDES * error)
        size = np.median(np.abs(high))
        share = np.mean(error > max(_UNRESOLVED * size, least or floor, _ABOVE * noise_of))
        if share > _NODES:
            warn_of_accuracy(
                f"the {name} is not resolved by the grid at {share:.1%} of the nodes: by differences of lower order, "
                f"its error there exceeds {_UNRESOLVED:.0%} of its median size {size:.2g} (the greatest value is "
                f"{np.abs(high).max():.2g}). Use a finer grid, a smaller domain, smoother tensors, or a metric from "
                "TensorField.from_function, whose derivatives are exact"
            )
            return


def _mean(tensors: Float[np.ndarray, "*shape d d"]) -> Float[np.ndarray, "*shape"]:
    return np.trace(tensors, axis1=-2, axis2=-1) / tensors.shape[-1]


def _roughness(tensors: Float[np.ndarray, "*shape d d"], grid: Grid, order: int) -> float:
    """Return the standard deviation of independent noise of the diagonal components, relative to the mean eigenvalue.

    High differences remove smooth fields; their median ignores the few nodes at edges of the anatomy.
    """
    weights = np.array([(-1) ** k * comb(order, k) for k in range(order + 1)])
    found = []
    for axis, n in enumerate(grid.shape):
        parts, mean, inside = (
            np.moveaxis(a, axis, 0) for a in (np.diagonal(tensors, axis1=-2, axis2=-1), _mean(tensors), grid.inside)
        )
        rows = range(n - order)
        if not rows:
            continue
        windows = [slice(k, k + len(rows)) for k in range(order + 1)]
        difference = sum(w * parts[part] for w, part in zip(weights, windows, strict=True))
        whole = np.logical_and.reduce([inside[part] for part in windows])
        found.append(np.abs(difference / mean[windows[order // 2]][..., None])[whole].ravel())
    values = np.concatenate(found) if found else np.zeros(0)
    return _NORMAL * float(np.median(values)) / float(np.linalg.norm(weights)) if values.size else 0.0
