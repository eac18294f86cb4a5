"""How many eigenvalues lie below a number, without computing any."""

import math
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from hks_jax.checks import require_number
from hks_jax.compilation import jit_quickly
from hks_jax.eigen.quality import largest
from hks_jax.fem.assembly import MassKind
from hks_jax.fem.boundary import BoundarySpec
from hks_jax.fem.elements import Quadrature
from hks_jax.fem.pencil import AnyPencil, Pencil
from hks_jax.fem.space import MatrixSpace
from hks_jax.fem.sparse_input import pencil_of
from hks_jax.linear.dissection import Dissection, dissect
from hks_jax.linear.factorised_matrix import certain_factorisation
from hks_jax.linear.multifrontal import factorise, try_out
from hks_jax.linear.operators import DiagonalOperator, PatternedOperator
from hks_jax.linear.pencil import SymmetricPencil
from hks_jax.traced import is_traced

_BESIDE = (1e-6, 1e-5, 1e-4, 1e-3)
"""How far beside σ, relative, to count where the factorisation at σ itself is not to be trusted."""

Count = tuple[Int[Array, ""], Bool[Array, ""]]


def count_eigenvalues(
    domain: Any,
    below: Float[Array, ""] | float,
    boundary: BoundarySpec = "neumann",
    mass: MassKind = "consistent",
) -> Int[Array, ""]:
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
    """Return the pencil of a domain as a user gives it.

    Of matrices and forms of the user's own, where concrete, M is tested for definiteness.
    """
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


def count_below(pencil: AnyPencil, below: Float[Array, ""] | float) -> Int[Array, ""]:
    """Count the eigenvalues of a pencil below a number; see `count_eigenvalues`."""
    shift = jnp.asarray(below, pencil.parts[0].stiffness.dtype)
    count, sound = _total(pencil, shift)
    if is_traced((count, sound)):
        return jnp.where(sound, count, -1)
    if sound:
        return count
    size = max(abs(float(shift)), float(_smallest_scale(pencil)))
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


def _total(pencil: AnyPencil, shift: Float[Array, ""]) -> Count:
    """Return how many eigenvalues of all parts are below, and whether that is certain."""
    counts = [certain_count(part, shift) for part in pencil.parts]
    return sum((count for count, _ in counts), jnp.zeros((), int)), jnp.all(jnp.stack([sound for _, sound in counts]))


def certain_count(pencil: SymmetricPencil, shift: Float[Array, ""]) -> Count:
    """Return how many eigenvalues of one pencil are below σ, and whether that is certain."""
    return _certain_count(pencil, dissect(pencil.pattern), shift)


# The dissection is an argument: as a constant, 74 MB at 1024² nodes, it would be compiled.
@jit_quickly()
def _certain_count(pencil: SymmetricPencil, dissection: Dissection, shift: Float[Array, ""]) -> Count:
    factor, trial, _ = certain_factorisation(dissection, pencil, shift)
    return factor.negative, trial.sound


def count_once(
    pencil: SymmetricPencil,
    dissection: Dissection,
    shift: Float[Array, ""],
    probes: Float[Array, "n_dof b"],
    least: Float[Array, ""] | float = 0.0,
) -> Count:
    """Return what one factorisation says, and whether it is certain: random right-hand sides try it out."""
    factor = factorise(dissection, pencil.shifted(shift), least)
    return factor.negative, try_out(factor, pencil, shift, probes).sound


def _smallest_scale(pencil: AnyPencil) -> Float[Array, ""]:
    """Return the least distance of eigenvalues to expect: what σ near zero is compared with."""
    if isinstance(pencil, AnyPencil) and pencil.measured:
        assert pencil.volume is not None
        return 1 / pencil.volume ** (2 / pencil.space.dimension)
    assert isinstance(pencil, Pencil)
    return 1e-6 * largest(pencil)
