"""The coefficients of the heat kernel's short-time expansion in three dimensions."""

from typing import TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from hks_jax.curvature.jet import (
    Jet,
    at_nodes,
    domain_nodes,
    function_jet,
    metric_function,
    metric_jet,
    nodal_jet,
)
from hks_jax.curvature.laplace_beltrami import laplacian
from hks_jax.curvature.riemann import scalar, scalar_and_ricci_squared
from hks_jax.domain.tensor_field import TensorField

Coefficients: TypeAlias = list[Array]


def volume_coefficients(
    field: TensorField, order: int, wraps: tuple[bool, ...]
) -> tuple[Coefficients, Bool[np.ndarray, "*shape"]]:
    """Return 1, u₁ and u₂ up to the order, each (*shape), and the nodes where they are known.

    u₁ = R/6 and u₂ = (R² + 2|Ric|² + 4∇²R)/120 (see `hks_expansion`).
    """
    return (_nodal if field.function is None else _exact)(field, order, wraps)


def _exact(field: TensorField, order: int, wraps: tuple[bool, ...]) -> tuple[Coefficients, Bool[np.ndarray, "*shape"]]:
    metric, inside = metric_function(field), domain_nodes(field.grid, wraps)

    def curvature(x: Array) -> Array:
        return scalar(function_jet(metric, x))

    def coefficients(x: Array) -> Coefficients:
        g = function_jet(metric, x)
        return _coefficients(g, function_jet(curvature, x) if order == 2 else None)[: order + 1]

    return at_nodes(coefficients, field.grid, inside), inside


def _nodal(field: TensorField, order: int, wraps: tuple[bool, ...]) -> tuple[Coefficients, Bool[np.ndarray, "*shape"]]:
    g, known = metric_jet(field, wraps)
    R = None
    if order == 2:
        R, known = nodal_jet(scalar(g), field.grid, known, wraps)
    return _coefficients(g, R)[: order + 1], known


def _coefficients(metric: Jet, curvature: Jet | None) -> Coefficients:
    """Return 1 and u₁, and with the jet of R also u₂."""
    R, ricci_squared = scalar_and_ricci_squared(metric)
    coefficients = [jnp.ones_like(R), R / 6]
    if curvature is not None:
        coefficients.append((R**2 + 2 * ricci_squared + 4 * laplacian(metric, curvature)) / 120)
    return coefficients
