"""The short-time expansion of the heat kernel signature in curvature."""

from collections.abc import Sequence
from functools import partial
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hks_jax.curvature.gaussian import brioschi, require_surface
from hks_jax.curvature.jet import (
    Jet,
    at_nodes,
    domain_nodes,
    function_jet,
    inner,
    metric_function,
    metric_jet,
    nan_outside,
    nodal_jet,
    wraps_per_axis,
)
from hks_jax.curvature.laplace_beltrami import laplacian
from hks_jax.domain import spd
from hks_jax.domain.tensor_field import TensorField
from hks_jax.signatures.times import checked_times

Invariants: TypeAlias = tuple[Array, ...]


def hks_expansion(
    field: TensorField, times: Any, order: int = 3, periodic: bool | Sequence[bool] = False
) -> Float[Array, "n_times *shape"]:
    """Return the short-time expansion of the heat kernel signature of a two-dimensional metric at the nodes,

        k_t(x, x) ≈ (1 + u₁t + u₂t² + u₃t³)/(4πt),
        u₁ = K/3,   u₂ = (K² + ∇²K)/15,   u₃ = 4K³/315 + 2|∇K|²/105 + K∇²K/30 + ∇⁴K/140,

    with the Gaussian curvature K and ∇² = div grad (Polterovich 2000; McKean and Singer 1967 to u₂). It knows of no
    boundary: it holds at distances well beyond 3√t from it.

    Exact, by JAX derivatives, when the field came from a function. Else by differences of sixth order, whose
    rounding errors grow with the sixth derivative that u₃ contains: relative to the result, about 30·ε·(t/h²)³ at nodes
    spaced h in length, with the floating-point ε. In float32 keep t below some 10 h², or the order below 3.

    Args:
        field: the metric, d = 2.
        times: (n_times,) positive, in length².
        order: the last power of t in the bracket, 0 … 3.
        periodic: whether the axes are periodic, one for all or one per axis.

    Returns:
        (n_times, *shape), in 1/length²; NaN outside the mask, and where no difference stencil fits in it.

    Raises:
        ValueError: a field that is not two-dimensional; times that are not a vector of positive numbers; order
            other than 0 … 3; fewer than 8 nodes on an axis of a nodal field; bad `periodic`.
    """
    require_surface(field)
    if order not in (0, 1, 2, 3):
        raise ValueError(f"order: got {order!r}; expected 0, 1, 2 or 3")
    return _hks_expansion(
        field, checked_times("times", times, field.tensors.dtype), int(order), wraps_per_axis(periodic, 2)
    )


@partial(jax.jit, static_argnums=(2, 3))
def _hks_expansion(
    field: TensorField, times: Float[Array, " n_times"], order: int, wraps: tuple[bool, ...]
) -> Float[Array, "n_times *shape"]:
    invariants, known = (_nodal if field.function is None else _exact)(field, order, wraps)
    t = times[:, None, None].astype(invariants[0].dtype)
    series = jnp.zeros_like(t)
    for u in reversed(_coefficients(*invariants)[: order + 1]):
        series = series * t + u
    return nan_outside(series / (4 * jnp.pi * t), known)


def _coefficients(K: Array, laplacian_K: Any = 0, gradient_squared: Any = 0, bilaplacian_K: Any = 0) -> list[Array]:
    """Return 1, u₁, u₂, u₃; right as far as their ingredients are given."""
    return [
        jnp.ones_like(K),
        K / 3,
        (K**2 + laplacian_K) / 15,
        4 * K**3 / 315 + 2 * gradient_squared / 105 + K * laplacian_K / 30 + bilaplacian_K / 140,
    ]


def _exact(field: TensorField, order: int, wraps: tuple[bool, ...]) -> tuple[Invariants, Bool[np.ndarray, "*shape"]]:
    """Return K, then as far as the order needs ∇²K, |∇K|² and ∇⁴K, as nested derivatives of the metric's function."""
    metric = metric_function(field)

    def curvature(x: Array) -> Invariants:
        return (brioschi(function_jet(metric, x)),)

    def second(x: Array) -> Invariants:
        g, K = function_jet(metric, x), _part(function_jet(curvature, x), 0)
        return K.value, laplacian(g, K), inner(spd.inverse(g.value), K.gradient, K.gradient)

    def third(x: Array) -> Invariants:
        jets = function_jet(second, x)
        return *jets.value, laplacian(function_jet(metric, x), _part(jets, 1))

    inside = domain_nodes(field.grid, wraps)
    return at_nodes((curvature, curvature, second, third)[order], field.grid, inside), inside


def _nodal(field: TensorField, order: int, wraps: tuple[bool, ...]) -> tuple[Invariants, Bool[np.ndarray, "*shape"]]:
    """Return the same by differences of differences, and the nodes where all are known."""
    g, known = metric_jet(field, wraps)
    invariants: Invariants = (brioschi(g),)
    if order >= 2:
        K, known = nodal_jet(invariants[0], field.grid, known, wraps)
        invariants += laplacian(g, K), inner(spd.inverse(g.value), K.gradient, K.gradient)
    if order >= 3:
        laplacian_K, known = nodal_jet(invariants[1], field.grid, known, wraps)
        invariants += (laplacian(g, laplacian_K),)
    return invariants, known


def _part(jets: Jet, index: int) -> Jet:
    """Return the jet of one component of a function with several."""
    return Jet(*(part[index] for part in jets))
