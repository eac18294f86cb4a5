"""A quantity with its first and second derivatives: by JAX where a function is known, else by differences."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hks_jax.curvature.differences import MINIMUM_NODES, differentiate
from hks_jax.domain import spd
from hks_jax.domain.components import active_elements, element_nodes
from hks_jax.domain.grid import Grid
from hks_jax.domain.tensor_field import TensorField

_BATCH = 4096


class Jet(NamedTuple):
    """A quantity and its derivatives at a point or at many; derivative indices come last."""

    value: Float[Array, "..."]
    gradient: Float[Array, "... d"]
    hessian: Float[Array, "... d d"]


def function_jet(fn: Callable[[Array], Any], x: Float[Array, " d"]) -> Jet:
    """Return the jet of a function at a point."""

    # The lower derivatives ride along as auxiliary outputs: else nested jets trace `fn` 7 times per level.
    def value(y: Array) -> tuple[Any, Any]:
        f = fn(y)
        return f, f

    def gradient(y: Array) -> tuple[Any, tuple[Any, Any]]:
        df, f = jax.jacfwd(value, has_aux=True)(y)
        return df, (f, df)

    hessian, (f, df) = jax.jacfwd(gradient, has_aux=True)(x)
    return Jet(f, df, hessian)


def nodal_jet(
    values: Float[Array, "*shape_and_components"],
    grid: Grid,
    inside: Bool[np.ndarray, "*shape"],
    wraps: tuple[bool, ...],
) -> tuple[Jet, Bool[np.ndarray, "*shape"]]:
    """Return the jets of nodal values by differences, and the nodes where all their derivatives are known."""
    if min(grid.shape) < MINIMUM_NODES:
        raise ValueError(
            f"grid: got shape {grid.shape}; differences of sixth order need at least {MINIMUM_NODES} nodes on every "
            "axis. Use a finer grid, or a metric given by TensorField.from_function"
        )
    d = grid.dimension

    def along(values: Array, inside: np.ndarray, axis: int, order: int) -> tuple[Array, np.ndarray]:
        return differentiate(values, inside, axis, order, grid.spacing[axis], wraps[axis])

    first = [along(values, inside, a, 1) for a in range(d)]
    second = [[along(*first[a], b, 1) if a < b else along(values, inside, a, 2) for b in range(a, d)] for a in range(d)]
    known = np.logical_and.reduce([valid for row in [first, *second] for _, valid in row])
    hessian = [[second[min(a, b)][abs(b - a)][0] for b in range(d)] for a in range(d)]
    return Jet(
        values,
        jnp.stack([derivative for derivative, _ in first], axis=-1),
        jnp.stack([jnp.stack(row, axis=-1) for row in hessian], axis=-2),
    ), known


def christoffel(metric: Jet) -> Float[Array, "... d d d"]:
    """Return the Christoffel symbols of the first kind, Γ_cab = (∂ₐg_cb + ∂ᵦg_ca − ∂_c g_ab)/2 at [..., c, a, b]."""
    slope = metric.gradient
    return (slope + jnp.swapaxes(slope, -1, -2) - jnp.moveaxis(slope, -1, -3)) / 2


def inner(inverse: Float[Array, "... d d"], p: Float[Array, "... d"], q: Float[Array, "... d"]) -> Float[Array, "..."]:
    """Return ⟨p, q⟩ = gᵃᵇ pₐ qᵦ of two covectors."""
    # Sums of products fuse, where XLA would make calls of as many tiny matrix products.
    return jnp.sum(inverse * p[..., :, None] * q[..., None, :], axis=(-2, -1))


def metric_function(field: TensorField) -> Callable[[Array], Array]:
    """Return the field's function, symmetrised, in the precision of its argument; NaN if not positive definite."""
    function = field.function
    assert function is not None
    return lambda x: spd.positive_or_nan(spd.symmetrise(jnp.asarray(function(x), x.dtype)))


def metric_jet(field: TensorField, wraps: tuple[bool, ...]) -> tuple[Jet, Bool[np.ndarray, "*shape"]]:
    """Return the jets of a metric at the nodes, (*shape, d, d, …), and the nodes where they are known."""
    inside = domain_nodes(field.grid, wraps)
    if field.function is None:
        return nodal_jet(field.domain_tensors, field.grid, inside, wraps)
    function = metric_function(field)
    return at_nodes(lambda x: function_jet(function, x), field.grid, inside), inside


def domain_nodes(grid: Grid, wraps: tuple[bool, ...]) -> Bool[np.ndarray, "*shape"]:
    """Mark the nodes of the elements that exist: everywhere else results are NaN."""
    return element_nodes(active_elements(grid.inside, wraps), wraps)


def at_nodes(fn: Callable[[Array], Any], grid: Grid, inside: Bool[np.ndarray, "*shape"]) -> Any:
    """Evaluate a function of position at every node: (*shape, …) for every array in its result.

    Nodes outside the domain get the value at some node inside: a function need not make sense outside, and a NaN
    there would spoil gradients even where it is masked afterwards.
    """
    flat = np.where(inside[..., None], grid.nodes, grid.nodes[inside][0]).reshape(-1, grid.dimension)
    # High derivatives hold many intermediates per node: batches bound their memory and keep them in the cache.
    n_batches = -(-grid.size // _BATCH)
    batches = np.resize(flat, (n_batches, -(-grid.size // n_batches), grid.dimension))
    values = jax.lax.map(jax.vmap(fn), jnp.asarray(batches, jnp.result_type(float)))
    return jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:])[: grid.size].reshape(*grid.shape, *a.shape[2:]), values)


def wraps_per_axis(periodic: bool | Sequence[bool], dimension: int) -> tuple[bool, ...]:
    """Return which axes are periodic.

    Raises:
        ValueError: anything but a bool, or one bool per axis.
    """
    wraps = (periodic,) * dimension if isinstance(periodic, bool | np.bool_) else tuple(periodic)
    if len(wraps) != dimension or not all(isinstance(wrap, bool | np.bool_) for wrap in wraps):
        raise ValueError(f"periodic: got {periodic!r}; expected True, False, or {dimension} of them, one per axis")
    return tuple(bool(wrap) for wrap in wraps)
