"""Quantities and their first and second derivatives: of functions by JAX, of nodal values by finite differences."""

from collections.abc import Callable, Sequence
from functools import lru_cache
from math import factorial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hks_jax.domain import spd
from hks_jax.domain.components import active_elements, element_nodes
from hks_jax.domain.grid import Grid
from hks_jax.domain.tensor_field import TensorField

MINIMUM_NODES = 8
"""The number of nodes of the widest stencil, which gives a one-sided second derivative of sixth order."""


@lru_cache
def stencils(order: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the sixth-order stencils of a first or second derivative: the centred one first, others by their shift.

    Row i of the offsets (n, 8) and of the weights (n, 8) is stencil i for unit spacing, padded with zeros. For the
    second derivative, a centred stencil of 7 nodes gains an order by symmetry; shifted stencils need 8 nodes.
    """
    width = 6 + order
    centred = np.arange(-3, 4)
    shifted = [run for s in range(-width + 1, 1) if not set(centred) <= set(run := np.arange(s, s + width))]
    runs = [centred, *sorted(shifted, key=lambda run: abs(run.sum()))]
    offsets = np.zeros((len(runs), MINIMUM_NODES), dtype=np.int32)
    weights = np.zeros((len(runs), MINIMUM_NODES))
    for row, run in enumerate(runs):
        for column, node in enumerate(run):
            # A node's weight is a derivative of its Lagrange polynomial at 0; the products of small integers are exact.
            others = run[run != node]
            offsets[row, column] = node
            weights[row, column] = factorial(order) * np.poly(others)[-1 - order] / np.prod(node - others)
    return offsets, weights


def differentiate(
    values: Float[Array, "*shape_and_components"],
    inside: Bool[np.ndarray, "*shape"],
    axis: int,
    order: int,
    spacing: float,
    wraps: bool,
) -> tuple[Float[Array, "*shape_and_components"], Bool[np.ndarray, "*shape"]]:
    """Return the first or second derivative of nodal values along a grid axis, and the nodes where it is known.

    Only values at nodes inside the domain are used. The derivative is 0 where no stencil lies inside the domain.
    """
    offsets, weights = stencils(order)
    n, d = inside.shape[axis], inside.ndim
    along = [n if a == axis else 1 for a in range(d)]
    # Without a mask, all grid lines along the axis have the same stencils, which are chosen for one line.
    choice, valid = _choose(np.ones(along, dtype=bool) if inside.all() else inside, offsets, axis, wraps)
    expand = tuple(range(d, jnp.ndim(values)))
    rows = np.expand_dims(choice, expand)
    nodes = np.expand_dims(np.arange(n, dtype=np.int32).reshape(along), expand)
    table, shifts = jnp.asarray(weights / spacing**order, values.dtype), jnp.asarray(offsets)
    total = jnp.zeros_like(values)
    for column in range(MINIMUM_NODES):
        index = (nodes + shifts[rows, column]) % n
        total += table[rows, column] * jnp.take_along_axis(values, index, axis=axis)
    valid = np.broadcast_to(valid, inside.shape)
    # Unknown derivatives are zero and not NaN, since 0·NaN would spoil the gradient of known derivatives.
    return jnp.where(np.expand_dims(valid, expand), total, 0), valid


def _choose(
    inside: np.ndarray, offsets: np.ndarray, axis: int, wraps: bool
) -> tuple[np.ndarray, Bool[np.ndarray, "*shape"]]:
    """Return for each node the first stencil with all nodes inside, or 0, and whether such a stencil exists."""
    reach = MINIMUM_NODES - 1
    width = [(reach, reach) if a == axis else (0, 0) for a in range(inside.ndim)]
    padded = np.pad(inside, width, mode="wrap") if wraps else np.pad(inside, width)
    n = inside.shape[axis]

    def shifted(offset: np.integer) -> np.ndarray:
        return padded.take(np.arange(reach + offset, reach + offset + n), axis=axis)

    fits = [np.logical_and.reduce([shifted(offset) for offset in run]) for run in offsets]
    return np.argmax(fits, axis=0).astype(np.int32), np.logical_or.reduce(fits)


_BATCH = 4096


class Jet(NamedTuple):
    """A jet: the value, gradient and Hessian of a quantity at one or many points; the derivatives' axes come last."""

    value: Float[Array, "..."]
    gradient: Float[Array, "... d"]
    hessian: Float[Array, "... d d"]


def function_jet(fn: Callable[[Array], Any], x: Float[Array, " d"]) -> Jet:
    """Return the jet of a function at a point."""

    # The value and the gradient are auxiliary outputs; otherwise each level of nested jets would trace `fn` 7 times.
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
    """Compute the jets of nodal values by finite differences; also return the nodes where all derivatives are known."""
    if min(grid.shape) < MINIMUM_NODES:
        raise ValueError(
            f"grid: got shape {grid.shape}; expected at least {MINIMUM_NODES} nodes on every axis, for differences "
            "of sixth order. Use a finer grid, or a metric from TensorField.from_function"
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
    # XLA fuses sums of products with other operations, but would call a library for each of many tiny matrix products.
    return jnp.sum(inverse * p[..., :, None] * q[..., None, :], axis=(-2, -1))


def metric_function(field: TensorField) -> Callable[[Array], Array]:
    """Return the field's function, symmetrised, in the dtype of its argument; NaN where it is not positive definite."""
    function = field.function
    assert function is not None
    return lambda x: spd.positive_or_nan(spd.symmetrise(jnp.asarray(function(x), x.dtype)))


def metric_jet(field: TensorField, wraps: tuple[bool, ...]) -> tuple[Jet, Bool[np.ndarray, "*shape"]]:
    """Return a metric and its derivatives at the nodes, and the nodes where the derivatives are known."""
    inside = domain_nodes(field.grid, wraps)
    if field.function is None:
        return nodal_jet(field.domain_tensors, field.grid, inside, wraps)
    function = metric_function(field)
    return at_nodes(lambda x: function_jet(function, x), field.grid, inside), inside


def domain_nodes(grid: Grid, wraps: tuple[bool, ...]) -> Bool[np.ndarray, "*shape"]:
    """Mark the nodes of the domain's elements; results are NaN at all other nodes."""
    return element_nodes(active_elements(grid.inside, wraps), wraps)


def at_nodes(fn: Callable[[Array], Any], grid: Grid, inside: Bool[np.ndarray, "*shape"]) -> Any:
    """Evaluate a function of position at every node; each array in the result has the shape (*shape, …).

    Nodes outside the domain get the function's value at a node inside. The function may be NaN outside, and NaN would
    enter the gradients even if a mask removed it from the values.
    """
    flat = np.where(inside[..., None], grid.nodes, grid.nodes[inside][0]).reshape(-1, grid.dimension)
    # High derivatives have many intermediates per node; batches limit their memory and keep them in the cache.
    n_batches = -(-grid.size // _BATCH)
    batches = np.resize(flat, (n_batches, -(-grid.size // n_batches), grid.dimension))
    values = jax.lax.map(jax.vmap(fn), jnp.asarray(batches, jnp.result_type(float)))
    return jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:])[: grid.size].reshape(*grid.shape, *a.shape[2:]), values)


def wraps_per_axis(periodic: bool | Sequence[bool], dimension: int) -> tuple[bool, ...]:
    """Return which axes are periodic; raise ValueError unless the argument is a bool or one bool per axis."""
    wraps = (periodic,) * dimension if isinstance(periodic, bool | np.bool_) else tuple(np.atleast_1d(periodic))
    if len(wraps) != dimension or not all(isinstance(wrap, bool | np.bool_) for wrap in wraps):
        raise ValueError(f"periodic: got {periodic!r}; expected True, False, or a tuple of {dimension}, one per axis")
    return tuple(bool(wrap) for wrap in wraps)
