"""The derivative of a spectral function: divided differences that mix eigenvectors, and a NumPy implementation."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hks_jax.compilation import jit_quickly
from hks_jax.eigen.derivative import change_of
from hks_jax.fem.space import FunctionSpace
from hks_jax.signatures.contractions import Contraction, Diagonal
from hks_jax.signatures.filters import Filter

_ON_HOST = 1 << 23
"""The number of entries of the eigenvectors, and of all filters' matrices, up to which NumPy differentiates."""


def weights_of(one: Filter, values: Float[Array, " k"], kept: Bool[Array, " k"]) -> Float[Array, " k"]:
    """Return f(λᵢ), or zero if the pair is not kept."""
    return jnp.where(kept, one(values), 0)


@jit_quickly(static_argnames="fixed")
def mixing(
    filters: Filter, values: Float[Array, " k"], kept: Bool[Array, " k"], fixed: bool
) -> tuple[Float[Array, "m k"], Float[Array, "m k k"], Float[Array, "m k k"], Bool[Array, "m k"]]:
    """Return f(λᵢ), the divided differences [f] and [λf], and which pairs matter, for each filter."""

    def of_one(one: Filter) -> tuple[Array, Array, Array, Array]:
        weights, (of_f, of_lambda_f) = weights_of(one, values, kept), _divided_differences(one, values, kept, fixed)
        return weights, of_f, of_lambda_f, _matters(weights, jnp.diagonal(of_f), values)

    return jax.lax.map(of_one, filters)


def _divided_differences(
    one: Filter, values: Float[Array, " k"], kept: Bool[Array, " k"], fixed: bool
) -> tuple[Float[Array, "k k"], Float[Array, "k k"]]:
    """Return the matrices [f] and [λf], where f is zero on pairs that are not kept."""
    rows, columns = values[:, None], values[None]
    low, high = jnp.minimum(rows, columns), jnp.maximum(rows, columns)
    f = weights_of(one, values, kept)
    gap = rows - columns
    quotient = (f[:, None] - f[None]) / jnp.where(gap == 0, 1, gap)
    both = kept[:, None] & kept[None]
    of_f = jnp.where(both, one.divided_difference(low, high), quotient)
    # G vanishes between null vectors that every perturbation annihilates, and f may have no derivative at 0.
    of_f = jnp.where((high == 0) & (fixed | ~jnp.isfinite(of_f)), 0, of_f)
    # Using f at the larger eigenvalue, where f is small, avoids cancellation.
    return of_f, jnp.where(gap >= 0, f[:, None], f[None]) + low * of_f


def _matters(f: Float[Array, " k"], slope: Float[Array, " k"], values: Float[Array, " k"]) -> Bool[Array, " k"]:
    """Return where f or λf' is not negligible relative to its largest size at positive eigenvalues."""
    size = jnp.maximum(jnp.abs(f), jnp.abs(values * slope))
    largest = jnp.max(jnp.where(values > 0, size, 0))
    # Between two negligible pairs, [f] is at most f' at one of them or, if f is not monotone, ε over the relative gap.
    return ~(size <= jnp.finfo(f.dtype).eps * largest)  # NaN counts as not negligible


def shapes(contraction: Contraction, filters: Filter, pairs: tuple[Array, Array, Array], *args: Any) -> Any:
    """Return the shape and dtype of the derivative."""
    vectors, m = pairs[1], len(jax.tree.leaves(filters)[0])
    return jax.eval_shape(contraction.weighted, jax.ShapeDtypeStruct((m, len(vectors)), vectors.dtype), vectors)


def by_numpy(known: list[Any], x: list[Any] | None, y: list[Any] | None) -> Any:
    """Return the derivative of a diagonal, or the cotangents of `d_frame` and of the change of the pencil, by NumPy."""
    contraction, filters, pairs, _, selection, fixed, copies, space, _, reader = known
    values, vectors, kept = map(np.asarray, pairs)
    k = len(values) if selection is None else len(selection[0])
    m = len(jax.tree.leaves(filters)[0])
    plain = isinstance(contraction, Diagonal) and reader is None and k > 0
    if x is None or not plain or vectors.size > _ON_HOST or m * k * k > _ON_HOST:
        return None
    rows: Any = slice(None)
    if selection is not None:
        rows, own = map(np.asarray, selection)
        values, kept, vectors = values[rows], kept[rows], np.where(own[:, None], vectors[rows], 0)
    weights, of_f, of_lambda_f, matters = map(
        np.asarray, mixing(filters, jax.device_put(values), jax.device_put(kept), fixed)
    )
    change = x[8]
    # Only the first n pairs matter, so the symmetric sum over i and j needs only i < n. Terms with j ≥ n count twice.
    last = [int(np.max(np.flatnonzero(one), initial=-1)) + 1 for one in matters]
    times = [np.where(np.arange(k) < n, 1, 2) for n in last]

    def transferred(functions: np.ndarray, of: FunctionSpace, to: FunctionSpace) -> np.ndarray:
        return np.asarray(of.transfer(jax.device_put(functions), to))

    moved = transferred(vectors, space, change.space)
    if y is None:
        images = ((matrix.to_scipy() @ moved.T).T for matrix in (change.stiffness, change.mass))
        stiffness, mass = (copies * transferred(each, change.space, space) @ vectors.T for each in images)
        d_frame = np.where(kept[:, None], np.asarray(x[3])[rows], 0)
        result = weights @ (2 * vectors * d_frame)
        for one, (n, count) in enumerate(zip(last, times, strict=True)):
            matrix = (of_f[one] * stiffness - of_lambda_f[one] * mass)[:n] * count
            result[one] += np.sum(vectors[:n] * (matrix @ vectors), axis=0)
        return result
    # The transpose of the steps above follows.
    stiffness, mass = np.zeros((k, k), vectors.dtype), np.zeros((k, k), vectors.dtype)
    for one, (n, count) in enumerate(zip(last, times, strict=True)):
        outer = (vectors[:n] * y[0][one]) @ vectors.T * count
        stiffness[:n] += of_f[one, :n] * outer
        mass[:n] -= of_lambda_f[one, :n] * outer
    d_frame = np.zeros(x[3].shape, x[3].dtype)
    d_frame[rows] = np.where(kept[:, None], 2 * vectors * (weights.T @ y[0]), 0)
    images = (transferred(copies * each @ vectors, space, change.space) for each in (stiffness, mass))
    return d_frame, change_of(change, moved, *images)
