"""Where the spectrum of any pencil begins, and how dense it is at some place: by counting below a few shifts."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from hks_jax.compilation import jit_quickly
from hks_jax.eigen.count import count_once
from hks_jax.linear.dissection import Dissection, dissect
from hks_jax.linear.loops import while_loop
from hks_jax.linear.pencil import SymmetricPencil
from hks_jax.traced import is_traced

_TRIES = 60
"""Factorisations before giving up."""
_JUST_BELOW = 0.625
"""The distance from zero at which the count of a singular matrix is still accurate, as a power of ε."""
_ALIKE = 1e-3
"""The relative difference of two distances below which the eigenvalues between them count as one multiple one."""
_NARROW = 8
"""How many times that distance a bracket is not divided any more."""


class LocatedPencil(SymmetricPencil):
    """K − σ₀M and M, and what inertia says of the spectrum above the origin σ₀; of null vectors nothing is known."""

    negative: Int[Array, ""]  # how many eigenvalues lie below the origin
    first: Float[Array, ""]  # a number above the origin with about as many eigenvalues below it as were asked for
    spacing: Float[Array, ""]  # the mean distance of eigenvalues between the two


def translated(
    pencil: SymmetricPencil,
    origin: Float[Array, ""],
    negative: Int[Array, ""],
    first: Float[Array, ""],
    spacing: Float[Array, ""],
) -> LocatedPencil:
    """Return the pencil whose eigenvalues are counted from the origin."""
    moved = pencil.stiffness.with_flat(pencil.shifted(jax.lax.stop_gradient(origin)))
    return LocatedPencil(moved, pencil.mass, *jax.lax.stop_gradient((negative, first, spacing)))


class _Descent(NamedTuple):
    """What is known of the eigenvalues next below an origin."""

    near: Float[Array, ""]  # the largest distance tried within which there are few enough; 0 at first
    number: Int[Array, ""]  # how many those are
    far: Float[Array, ""]  # the least distance tried within which there are too many; ∞ before there is one
    far_number: Int[Array, ""]  # how many those are
    next: Float[Array, ""]  # what to try next
    tries: Int[Array, ""]  # counts so far


def lowered(pencil: LocatedPencil, most: int, probes: int) -> tuple[Float[Array, ""], Int[Array, ""]]:
    """Return a distance by which to lower an origin, and the number of eigenvalues passed: `most`/2 to `most`.

    Fewer only where there are no more, or where the next is a multiple one that would be too many. Each factorisation
    is tried out on `probes` random right-hand sides.
    """
    dissection, dtype = _dissected(pencil), pencil.stiffness.dtype
    tried = jax.random.normal(jax.random.key(0), (pencil.size, probes), dtype)

    def going_on(state: _Descent) -> Bool[Array, ""]:
        return _descends(state, pencil.negative, pencil.spacing, most)

    def step(state: _Descent) -> _Descent:
        return _descended(state, *count_once(pencil, dissection, -state.next, tried), pencil.negative, most)

    nothing, none = jnp.zeros((), dtype), jnp.zeros((), int)
    first = 3 / 4 * most * pencil.spacing
    state = while_loop(going_on, step, _Descent(nothing, none, nothing + jnp.inf, none, first, none))
    return state.near, state.number


@partial(jax.jit, static_argnames="most")
def _descends(state: _Descent, negative: Int[Array, ""], spacing: Float[Array, ""], most: int) -> Bool[Array, ""]:
    few = (2 * state.number < most) & (state.number < negative)
    narrow = state.far - state.near <= _ALIKE * jnp.maximum(state.near, spacing)
    return few & ~narrow & (state.tries < _TRIES)


@partial(jax.jit, static_argnames="most")
def _descended(
    state: _Descent, count: Int[Array, ""], sound: Bool[Array, ""], negative: Int[Array, ""], most: int
) -> _Descent:
    """Return what is known after a count, and where to count next."""
    passed = negative - count
    nearer, farther = sound & (passed <= most), sound & (passed > most)
    near, number = jnp.where(nearer, state.next, state.near), jnp.where(nearer, passed, state.number)
    far, far_number = jnp.where(farther, state.next, state.far), jnp.where(farther, passed, state.far_number)
    share = (3 * most // 4 - number) / jnp.maximum(far_number - number, 1)
    between = near + jnp.clip(share.astype(near.dtype), 1 / 8, 7 / 8) * (far - near)
    following = jnp.where(jnp.isfinite(far), between, 4 * near)
    # Where the count is not to be trusted, try beside.
    following = jnp.where(sound, following, state.next + 1e-2 * (jnp.minimum(far, 2 * state.next) - state.next))
    return _Descent(near, number, far, far_number, following, state.tries + 1)


class _Search(NamedTuple):
    """What is known between two counts."""

    low: Float[Array, ""]  # the highest number tried below which there is no eigenvalue; −∞ before there is one
    high: Float[Array, ""]  # the lowest number tried below which there are some; ∞ before there is one
    number: Int[Array, ""]  # how many lie below ``high``
    first: Float[Array, ""]  # the highest number tried with as many below it: far from them, solves are accurate
    next: Float[Array, ""]  # what to try next
    tries: Int[Array, ""]  # counts so far


def locate(
    pencil: SymmetricPencil, wanted: int, probes: int
) -> tuple[Float[Array, ""], Float[Array, ""], Int[Array, ""]]:
    """Return an origin below all eigenvalues, a number above some of them, 1 … 2·wanted, and how many that are.

    A bracket is halved, or divided in proportion to the counts, until there are few enough eigenvalues in it. Each
    factorisation is tried out on `probes` random right-hand sides. Where many eigenvalues are equal within rounding
    there are more than 2·wanted.
    NaN where nothing succeeds.
    """
    size, dissection = scale(pencil), _dissected(pencil)
    tried = jax.random.normal(jax.random.key(0), (pencil.size, probes), size.dtype)
    infinite = jnp.full((), jnp.inf, size.dtype)
    # Just below zero: of a singular K ⪰ 0 there is no eigenvalue below it, and the factorisation is still accurate.
    least = jnp.asarray(float(jnp.finfo(size.dtype).eps) ** _JUST_BELOW, size.dtype) * size
    state = _Search(-infinite, infinite, jnp.zeros((), int), infinite, -least, jnp.zeros((), int))

    def step(state: _Search) -> _Search:
        return _narrowed(state, *count_once(pencil, dissection, state.next, tried), size, wanted, pencil.size)

    # Step by step, the computations are those of the slices that follow: compiled once for both.
    state = while_loop(lambda state: _unfinished(state, wanted, least), step, state)
    known = jnp.isfinite(state.low) & jnp.isfinite(state.high)
    low, first = (jnp.where(known, end, jnp.nan) for end in (state.low, state.first))
    return low, first, state.number


@partial(jax.jit, static_argnames="wanted")
def _unfinished(state: _Search, wanted: int, least: Float[Array, ""]) -> Bool[Array, ""]:
    few = (state.number <= 2 * wanted) | (state.high - state.low <= _NARROW * least)
    return ~(jnp.isfinite(state.low) & jnp.isfinite(state.high) & few) & (state.tries < _TRIES)


@partial(jax.jit, static_argnames=("wanted", "n"))
def _narrowed(
    state: _Search, count: Int[Array, ""], sound: Bool[Array, ""], size: Float[Array, ""], wanted: int, n: int
) -> _Search:
    """Return what is known after a count, and where to count next."""
    dtype = size.dtype
    low = jnp.where(sound & (count == 0), jnp.maximum(state.low, state.next), state.low)
    lower = sound & (count > 0) & (state.next < state.high)
    high, number = jnp.where(lower, state.next, state.high), jnp.where(lower, count, state.number)
    first = jnp.where(lower & (count != state.number), state.next, state.first)
    share = jnp.clip(wanted / jnp.maximum(number, 1).astype(dtype), 1 / 16, 1 / 2)
    # Without a lower end go down, without an upper one up; each time four times as far.
    reach = size * jnp.asarray(4.0, dtype) ** (state.tries - 1).astype(dtype)
    up = jnp.maximum(low, 0) + reach * wanted / n
    bracketed = jnp.isfinite(low) & jnp.isfinite(high)
    following = jnp.where(bracketed, low + share * (high - low), jnp.where(jnp.isfinite(high), -reach, up))
    # Where the count is not to be trusted, try beside.
    beside = state.next + 1e-3 * jnp.where(bracketed, high - low, size * wanted / n)
    return _Search(low, high, number, first, jnp.where(sound, following, beside), state.tries + 1)


def _dissected(pencil: SymmetricPencil) -> Dissection:
    dissection = dissect(pencil.pattern)
    return dissection if is_traced(pencil) else jax.device_put(dissection)


@jit_quickly()
def scale(pencil: SymmetricPencil) -> Float[Array, ""]:
    """Return the size of the largest eigenvalue, roughly: rows of |K| over the diagonal of M; 1 where all are zero."""
    data, (rows, _) = pencil.stiffness.triplets()
    size = jnp.max(jax.ops.segment_sum(jnp.abs(data), rows, pencil.size) / pencil.mass.diagonal())
    return jnp.where(size > 0, size, 1)
