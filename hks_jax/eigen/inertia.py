"""What inertia says of a spectrum: how many eigenvalues lie below a number, where they begin, how dense they are."""

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from hks_jax.checks import require_number
from hks_jax.compilation import jit_quickly
from hks_jax.eigen.quality import largest
from hks_jax.fem.assembly import MassKind
from hks_jax.fem.boundary import BoundarySpec
from hks_jax.fem.elements import Quadrature
from hks_jax.fem.pencil import AnyPencil
from hks_jax.fem.space import MatrixSpace
from hks_jax.fem.sparse_input import pencil_of
from hks_jax.linear.dissection import Dissection, dissect
from hks_jax.linear.factorised_matrix import certain_factorisation
from hks_jax.linear.loops import while_loop
from hks_jax.linear.multifrontal import factorise, try_out
from hks_jax.linear.operators import DiagonalOperator, PatternedOperator
from hks_jax.linear.pencil import SymmetricPencil
from hks_jax.traced import is_traced

_BESIDE = (1e-6, 1e-5, 1e-4, 1e-3)
"""How far beside σ, relative, to count where the factorisation at σ itself is not to be trusted."""
_TRIES = 60
"""Factorisations before giving up."""
_JUST_BELOW = 0.625
"""The distance from zero at which the count of a singular matrix is still accurate, as a power of ε."""
_ALIKE = 1e-3
"""The relative difference of two distances below which the eigenvalues between them count as one multiple one."""
_NARROW = 8
"""How many times that distance a bracket is not divided any more."""

Scalar = Float[Array, ""]
Number = Int[Array, ""]
Flag = Bool[Array, ""]
Count = tuple[Number, Flag]
"""How many eigenvalues there are, and whether that is certain."""


def count_eigenvalues(
    domain: Any, below: Scalar | float, boundary: BoundarySpec = "neumann", mass: MassKind = "consistent"
) -> Number:
    """Count the eigenvalues below a number, with their multiplicities.

    By Sylvester's law of inertia these are the negative eigenvalues of K − σM, which a factorisation LDLᵀ shows: one
    factorisation certifies that a list of eigenvalues is complete. Each is tried out on random right-hand sides, and
    counts only where its error is too small to change the inertia. Where it is not, because σ is an eigenvalue or one
    of a part of the domain, it is counted on both sides of σ. Traceable.

    Args:
        domain: what `eigenpairs` takes: a tensor field, a mesh, a pencil, K, or (K, M).
        below: σ, in 1/(metric length)²; not itself an eigenvalue, where the count is uncertain.
        boundary: see `assemble`; belongs to the pencil if one is given.
        mass: likewise.

    Returns:
        How many eigenvalues are less than σ; traced, −1 where that is uncertain.

    Raises:
        ValueError: σ is not a finite number, or cannot be told from an eigenvalue, with the counts beside it; what
            `eigenpairs` refuses of the domain.
    """
    require_number("below", below, above=-math.inf)
    return count_below(checked_pencil(domain, boundary, mass), below)


def checked_pencil(domain: Any, boundary: BoundarySpec, mass: MassKind, quadrature: Quadrature = "gauss") -> AnyPencil:
    """Return the pencil of a domain as a user gives it; an M of the user's own, where concrete, is definite."""
    pencil = pencil_of(domain, boundary, mass, quadrature)
    for part in jax.lax.stop_gradient(pencil).parts:
        own = isinstance(part.space, MatrixSpace) or part.volume is None
        if not own or isinstance(part.mass, DiagonalOperator) or is_traced(part):
            continue
        assert isinstance(part.mass, PatternedOperator)
        ones, zero = jnp.ones(part.size, part.mass.dtype), jnp.zeros((), part.mass.dtype)
        negative, sound = certain_count(SymmetricPencil(part.mass, DiagonalOperator(ones)), zero)
        if int(negative) or not sound:
            what = f"{int(negative)} negative eigenvalue(s)" if sound else "an eigenvalue that is zero within rounding"
            name = "M" if isinstance(part.space, MatrixSpace) else "mass"
            raise ValueError(f"{name}: it has {what}, by the inertia of its factorisation; expected positive definite")
    return pencil


def count_below(pencil: AnyPencil, below: Scalar | float) -> Number:
    """Count the eigenvalues of a pencil below a number; see `count_eigenvalues`."""
    shift = jnp.asarray(below, pencil.parts[0].stiffness.dtype)
    count, sound = _total(pencil, shift)
    if is_traced((count, sound)):
        return jnp.where(sound, count, -1)
    if sound:
        return count
    # σ near zero is compared with the least distance of eigenvalues to expect.
    volume, dimension = pencil.volume, pencil.space.dimension
    least = 1e-6 * largest(pencil.parts[0]) if volume is None or dimension is None else volume ** (-2 / dimension)
    size = max(abs(float(shift)), float(least))
    for relative in _BESIDE:
        low, high = float(shift) - relative * size, float(shift) + relative * size
        (under, sound_under), (over, sound_over) = (_total(pencil, jnp.asarray(s, shift.dtype)) for s in (low, high))
        if sound_under and sound_over:
            if under == over:
                return under
            raise ValueError(
                f"below: got {float(shift):.15g}, which cannot be told from an eigenvalue; {int(under)} eigenvalues "
                f"are below {low:.12g} and {int(over)} below {high:.12g}. Count below one of these"
            )
    raise ValueError(
        f"below: got {float(shift):.15g}, where rounding in {shift.dtype} leaves the count uncertain. "
        "Use another number, or float64"
    )


def _total(pencil: AnyPencil, shift: Scalar) -> Count:
    """Return how many eigenvalues of all parts are below, and whether that is certain."""
    counts = [certain_count(part, shift) for part in pencil.parts]
    return sum((count for count, _ in counts), jnp.zeros((), int)), jnp.all(jnp.stack([sound for _, sound in counts]))


def certain_count(pencil: SymmetricPencil, shift: Scalar) -> Count:
    """Return how many eigenvalues of one pencil are below σ, and whether that is certain."""
    return _certain_count(pencil, dissect(pencil.pattern), shift)


# The dissection is an argument: as a constant, 74 MB at 1024² nodes, it would be compiled.
@jit_quickly()
def _certain_count(pencil: SymmetricPencil, dissection: Dissection, shift: Scalar) -> Count:
    factor, trial, _ = certain_factorisation(dissection, pencil, shift)
    return factor.negative, trial.sound


class LocatedPencil(SymmetricPencil):
    """K − σ₀M and M, and what inertia says of the spectrum above the origin σ₀; of null vectors nothing is known."""

    negative: Number  # how many eigenvalues lie below the origin
    first: Scalar  # a number above the origin with about as many eigenvalues below it as were asked for
    spacing: Scalar  # the mean distance of eigenvalues between the two


def translated(
    pencil: SymmetricPencil, origin: Scalar, negative: Number, first: Scalar, spacing: Scalar
) -> LocatedPencil:
    """Return the pencil whose eigenvalues are counted from the origin."""
    moved = pencil.stiffness.with_flat(pencil.shifted(jax.lax.stop_gradient(origin)))
    return LocatedPencil(moved, pencil.mass, *jax.lax.stop_gradient((negative, first, spacing)))


class _Descent(NamedTuple):
    """What is known of the eigenvalues next below an origin."""

    near: Scalar  # the largest distance tried within which there are few enough; 0 at first
    number: Number  # how many those are
    far: Scalar  # the least distance tried within which there are too many; ∞ before there is one
    far_number: Number  # how many those are
    next: Scalar  # what to try next
    tries: Number  # counts so far
    going: Flag  # whether to go on


def lowered(pencil: LocatedPencil, most: int, probes: int) -> tuple[Scalar, Number]:
    """Return a distance by which to lower an origin, and the number of eigenvalues passed: `most`/2 to `most`.

    Fewer only where there are no more, or where the next is a multiple one that would be too many. Each factorisation
    is tried out on `probes` random right-hand sides.
    """
    count, dtype = _counting(pencil, probes), pencil.stiffness.dtype

    def step(state: _Descent) -> _Descent:
        return _descended(state, *count(-state.next), pencil.negative, pencil.spacing, most)

    nothing, none = jnp.zeros((), dtype), jnp.zeros((), int)
    first, going = 3 / 4 * most * pencil.spacing, (pencil.negative > 0) & (most > 0)
    start = _Descent(nothing, none, nothing + jnp.inf, none, first, none, going)
    state = while_loop(lambda state: state.going, step, start)
    return state.near, state.number


@partial(jax.jit, static_argnames="most")
def _descended(state: _Descent, count: Number, sound: Flag, negative: Number, spacing: Scalar, most: int) -> _Descent:
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
    few, narrow = (2 * number < most) & (number < negative), far - near <= _ALIKE * jnp.maximum(near, spacing)
    tries = state.tries + 1
    return _Descent(near, number, far, far_number, following, tries, few & ~narrow & (tries < _TRIES))


class _Search(NamedTuple):
    """What is known between two counts."""

    low: Scalar  # the highest number tried below which there is no eigenvalue; −∞ before there is one
    high: Scalar  # the lowest number tried below which there are some; ∞ before there is one
    number: Number  # how many lie below ``high``
    first: Scalar  # the highest number tried with as many below it: far from them, solves are accurate
    next: Scalar  # what to try next
    tries: Number  # counts so far
    going: Flag  # whether to go on


def locate(pencil: SymmetricPencil, wanted: int, probes: int) -> tuple[Scalar, Scalar, Number]:
    """Return an origin below all eigenvalues, a number above some of them, 1 … 2·wanted, and how many that are.

    A bracket is halved, or divided in proportion to the counts, until there are few enough eigenvalues in it. Each
    factorisation is tried out on `probes` random right-hand sides. Where many eigenvalues are equal within rounding
    there are more than 2·wanted. NaN where nothing succeeds.
    """
    size, count = scale(pencil), _counting(pencil, probes)
    infinite = jnp.full((), jnp.inf, size.dtype)
    # Just below zero: of a singular K ⪰ 0 there is no eigenvalue below it, and the factorisation is still accurate.
    least = jnp.asarray(float(jnp.finfo(size.dtype).eps) ** _JUST_BELOW, size.dtype) * size
    none = jnp.zeros((), int)

    def step(state: _Search) -> _Search:
        return _narrowed(state, *count(state.next), size, least, wanted, pencil.size)

    # Step by step, the computations are those of the slices that follow: compiled once for both.
    start = _Search(-infinite, infinite, none, infinite, -least, none, jnp.ones((), bool))
    state = while_loop(lambda state: state.going, step, start)
    known = jnp.isfinite(state.low) & jnp.isfinite(state.high)
    low, first = (jnp.where(known, end, jnp.nan) for end in (state.low, state.first))
    return low, first, state.number


@partial(jax.jit, static_argnames=("wanted", "n"))
def _narrowed(state: _Search, count: Number, sound: Flag, size: Scalar, least: Scalar, wanted: int, n: int) -> _Search:
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
    few, tries = (number <= 2 * wanted) | (high - low <= _NARROW * least), state.tries + 1
    going = ~(bracketed & few) & (tries < _TRIES)
    return _Search(low, high, number, first, jnp.where(sound, following, beside), tries, going)


def _counting(pencil: SymmetricPencil, probes: int) -> Callable[[Scalar], Count]:
    """Return how to count eigenvalues below a shift by one factorisation, tried out on random right-hand sides."""
    dissection = dissected(pencil)
    tried = jax.random.normal(jax.random.key(0), (pencil.size, probes), pencil.stiffness.dtype)

    def count(shift: Scalar) -> Count:
        factor = factorise(dissection, pencil.shifted(shift))
        return factor.negative, try_out(factor, pencil, shift, tried).sound

    return count


def dissected(pencil: SymmetricPencil) -> Dissection:
    """Return the elimination tree, as arrays of the device where values are concrete."""
    dissection = dissect(pencil.pattern)
    return dissection if is_traced(pencil) else jax.device_put(dissection)


@jit_quickly()
def scale(pencil: SymmetricPencil) -> Scalar:
    """Return the size of the largest eigenvalue, roughly: rows of |K| over the diagonal of M; 1 where all are zero."""
    data, (rows, _) = pencil.stiffness.triplets()
    size = jnp.max(jax.ops.segment_sum(jnp.abs(data), rows, pencil.size) / pencil.mass.diagonal())
    return jnp.where(size > 0, size, 1)
