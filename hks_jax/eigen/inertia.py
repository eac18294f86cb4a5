"""Counts of eigenvalues by the inertia of factorisations, and a search for the lower end of a spectrum."""

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from hks_jax.arrays import Scalar
from hks_jax.checks import require_number
from hks_jax.compilation import jit_quickly
from hks_jax.eigen.quality import largest
from hks_jax.fem.assembly import MassKind
from hks_jax.fem.boundary import BoundarySpec
from hks_jax.fem.pencil import AnyPencil
from hks_jax.fem.sparse_input import pencil_of
from hks_jax.linear.dissection import Dissection, dissect
from hks_jax.linear.factorised_matrix import certain_factorisation
from hks_jax.linear.loops import while_loop
from hks_jax.linear.multifrontal import factorise, try_out
from hks_jax.linear.symmetric_pencil import SymmetricPencil
from hks_jax.traced import is_traced

_BESIDE = (1e-6, 1e-5, 1e-4, 1e-3)
"""Relative distances from a shift at which eigenvalues are counted if the factorisation at the shift is inaccurate."""
_CLEAR = 1e-2
"""The largest error of a solve, times √n, at which a shift is certainly no eigenvalue within rounding."""
_TRIES = 40
"""The maximal number of factorisations in a search."""
_UNCERTAIN = 5
"""The number of consecutive uncertain counts after which a bracket is not divided further."""
_JUST_BELOW = 0.625
"""The exponent p of the first shift −ε^p λ of a search, where λ is an estimate of the largest eigenvalue."""
_NARROW = 8
"""The width at which a bracket is not divided further, in units of the distance of the first shift from zero."""

Number = Int[Array, ""]
Flag = Bool[Array, ""]
Count = tuple[Number, Flag]
"""The number of eigenvalues, and whether it is certain."""


def count_eigenvalues(
    domain: Any, below: Scalar | float, boundary: BoundarySpec = "neumann", mass: MassKind = "consistent"
) -> Number:
    """Count the eigenvalues below a number σ, with their multiplicities.

    By Sylvester's law of inertia, the number of eigenvalues below σ is the number of negative eigenvalues of K − σM,
    which a factorisation LDLᵀ shows. So one factorisation certifies that a list of eigenvalues is complete. Random
    right-hand sides test whether the error of the factorisation could change its inertia. If σ is an eigenvalue of the
    domain or of a part of the domain, the factorisation may fail this test; outside `jit`, the function then counts the
    eigenvalues at two numbers just below and above σ. The function works under `jit`.

    Args:
        domain: a tensor field, a mesh, a pencil, K, or (K, M), as in `eigenpairs`.
        below: σ, in 1/(metric length)². The count is uncertain if σ is an eigenvalue.
        boundary: the boundary condition of a field or mesh; see `assemble`.
        mass: the mass matrix of a field or mesh; see `assemble`.

    Returns:
        The number of eigenvalues less than σ; −1 if values are traced and the number is uncertain.

    Raises:
        ValueError: σ is not finite, or too close to an eigenvalue (the message has the counts on both sides);
            `eigenpairs` does not accept the domain.

    Examples:
        >>> print(hj.count_eigenvalues(field, 20.0), (pairs.eigenvalues < 20.0).sum())
        5 5
    """
    require_number("below", below, above=-math.inf)
    return count_below(pencil_of(domain, boundary, mass), below)


def count_below(pencil: AnyPencil, below: Scalar | float) -> Number:
    """Count the eigenvalues of a pencil below a number; see `count_eigenvalues`."""
    shift = jnp.asarray(below, pencil.parts[0].stiffness.dtype)
    count, sound, clear = _total(pencil, shift)
    if is_traced((count, sound)):
        return jnp.where(sound, count, -1)
    if sound and clear:
        return count
    # Distances are relative to |σ| or, if σ is near zero, to the expected size of the lowest positive eigenvalue.
    volume, dimension = pencil.volume, pencil.space.dimension
    least = 1e-6 * largest(pencil.parts[0]) if volume is None or dimension is None else volume ** (-2 / dimension)
    size = max(abs(float(shift)), float(least))
    for relative in _BESIDE[:1] if sound else _BESIDE:
        low, high = float(shift) - relative * size, float(shift) + relative * size
        counts = (_total(pencil, jnp.asarray(s, shift.dtype)) for s in (low, high))
        (under, sound_under, _), (over, sound_over, _) = counts
        if sound_under and sound_over:
            if under == over:
                return under
            raise ValueError(
                f"below: got {float(shift):.15g}, which is too close to an eigenvalue; {int(under)} eigenvalues are "
                f"below {low:.12g} and {int(over)} are below {high:.12g}. Use one of these two bounds"
            )
    if sound:
        return count
    raise ValueError(
        f"below: got {float(shift):.15g}, at which rounding in {shift.dtype} leaves the count uncertain. "
        "Use another number, or float64"
    )


def _total(pencil: AnyPencil, shift: Scalar) -> tuple[Number, Flag, Flag]:
    """Return the number of eigenvalues below a shift, whether it is certain, and whether the shift is none of them."""
    counts, sound, rates = zip(*(_counted(part, dissect(part.pattern), shift) for part in pencil.parts), strict=True)
    # At an eigenvalue within rounding, the sign of a pivot is right for the shift, but not for the computed eigenvalue.
    # The same solves that test the inertia then have residuals of the order of their right-hand sides.
    clear = [rate < _CLEAR / math.sqrt(part.size) for rate, part in zip(rates, pencil.parts, strict=True)]
    return sum(counts, jnp.zeros((), int)), jnp.all(jnp.stack(sound)), jnp.all(jnp.stack(clear))


# The nested dissection is an argument, because compilation with so large a constant (74 MB at 1024² nodes) is slow.
@jit_quickly()
def _counted(pencil: SymmetricPencil, dissection: Dissection, shift: Scalar) -> tuple[Number, Flag, Scalar]:
    """Return the number of eigenvalues below a shift, whether it is certain, and the rate of `Trial`."""
    factor, trial, _ = certain_factorisation(dissection, pencil, shift)
    return factor.negative, trial.sound, trial.rate


class _Search(NamedTuple):
    """The state of a search for the lower end of the spectrum: a bracket [low, high]."""

    low: Scalar  # the highest shift so far with no eigenvalue below it; −∞ at first
    high: Scalar  # the lowest shift so far with eigenvalues below it; ∞ at first
    number: Number  # the number of eigenvalues below `high`
    first: Scalar  # the highest shift with `number` eigenvalues below it; solves there are most accurate
    next: Scalar  # the shift below which eigenvalues are counted next
    uncertain: Number  # the number of consecutive uncertain counts
    tries: Number  # the number of factorisations so far
    going: Flag  # whether the search goes on


def locate(pencil: SymmetricPencil, wanted: int, probes: int) -> tuple[Scalar, Scalar, Number]:
    """Return an origin below all eigenvalues, a shift above the lowest 1 to 2·wanted eigenvalues, and their number.

    A bracket is halved, or divided in proportion to the counts, until it contains few enough eigenvalues. Each
    factorisation is tested with `probes` random right-hand sides. If rounding does not separate many eigenvalues, or
    `_TRIES` factorisations do not, the number exceeds 2·wanted. Without a bracket, the origin and the shift are NaN.
    """
    size, count = scale(pencil), _counting(pencil, probes)
    infinite = jnp.full((), jnp.inf, size.dtype)
    # The first shift is just below zero: a singular K ⪰ 0 has no eigenvalue below it, and an accurate factorisation.
    least = jnp.asarray(float(jnp.finfo(size.dtype).eps) ** _JUST_BELOW, size.dtype) * size
    none = jnp.zeros((), int)

    def step(state: _Search) -> _Search:
        return _narrowed(state, *count(state.next), size, least, wanted, pencil.size)

    # Outside `jit`, the search for the origin calls the same compiled factorisation as spectrum slicing, which follows.
    start = _Search(-infinite, infinite, none, infinite, -least, none, none, jnp.ones((), bool))
    state = while_loop(lambda state: state.going & (state.tries < _TRIES), step, start)
    found = jnp.isfinite(state.low) & jnp.isfinite(state.high)
    low, first = (jnp.where(found, end, jnp.nan) for end in (state.low, state.first))
    return low, first, state.number


@partial(jax.jit, static_argnames=("wanted", "n"))
def _narrowed(state: _Search, count: Number, sound: Flag, size: Scalar, least: Scalar, wanted: int, n: int) -> _Search:
    dtype = size.dtype
    low = jnp.where(sound & (count == 0), jnp.maximum(state.low, state.next), state.low)
    lower = sound & (count > 0) & (state.next < state.high)
    high, number = jnp.where(lower, state.next, state.high), jnp.where(lower, count, state.number)
    first = jnp.where(lower & (count != state.number), state.next, state.first)
    share = jnp.clip(wanted / jnp.maximum(number, 1).astype(dtype), 1 / 16, 1 / 2)
    # If the bracket has no lower end yet, the shift decreases; if it has no upper end yet, the shift increases.
    down, up = jnp.minimum(-size, 4 * state.next), 4 * jnp.maximum(low, 0) + size * wanted / n
    bracketed = jnp.isfinite(low) & jnp.isfinite(high)
    following = jnp.where(bracketed, low + share * (high - low), jnp.where(jnp.isfinite(high), down, up))
    # If the number of eigenvalues below a shift is uncertain, the next shift is slightly larger. But if even the lower
    # end is unknown, the shift moves away from zero by a factor: size may be many orders larger than the lowest
    # eigenvalues, as for a nearly incompressible body.
    beside = state.next + 1e-3 * jnp.where(bracketed, high - low, size * wanted / n)
    beside = jnp.where(jnp.isfinite(low), beside, 4 * state.next)
    uncertain = jnp.where(sound, 0, state.uncertain + 1)
    few = (number <= 2 * wanted) | (high - low <= _NARROW * least) | (uncertain >= _UNCERTAIN)
    following = jnp.where(sound, following, beside)
    return _Search(low, high, number, first, following, uncertain, state.tries + 1, ~(bracketed & few))


def _counting(pencil: SymmetricPencil, probes: int) -> Callable[[Scalar], Count]:
    """Return a function that counts eigenvalues below a shift by one factorisation, tested with random vectors."""
    dissection = dissected(pencil)
    tried = jax.random.normal(jax.random.key(0), (pencil.size, probes), pencil.stiffness.dtype)

    def count(shift: Scalar) -> Count:
        factor = factorise(dissection, pencil.shifted(shift))
        return factor.negative, try_out(factor, pencil, shift, tried).sound

    return count


def dissected(pencil: SymmetricPencil) -> Dissection:
    """Return the elimination tree of a pencil, with its arrays on the device if values are concrete."""
    dissection = dissect(pencil.pattern)
    return dissection if is_traced(pencil) else jax.device_put(dissection)


@jit_quickly()
def scale(pencil: SymmetricPencil) -> Scalar:
    """Estimate the largest eigenvalue by the largest ratio of a row sum of |K| to the diagonal of M; 1 if K is zero."""
    data, (rows, _) = pencil.stiffness.triplets()
    size = jnp.max(jax.ops.segment_sum(jnp.abs(data), rows, pencil.size) / pencil.mass.diagonal())
    return jnp.where(size > 0, size, 1)
