"""Bounds on spectra, for Chebyshev polynomials, and on the speed of heat along an axis."""

from dataclasses import replace
from functools import partial
from itertools import product
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.fem.nodal import nodal_pencil
from hks_jax.fem.pencil import Pencil
from hks_jax.linear.chebyshev import gershgorin, lanczos_bound
from hks_jax.linear.operators import DiagonalOperator

_STEPS, _MASS_STEPS = 50, 200


class Bounds(NamedTuple):
    """Bounds for the polynomials that approximate a pencil's heat kernel; `plan` converts them to NumPy numbers.

    The diagonal matrix D holds the row sums of M. For each axis, ``reach`` bounds the eigenvalues of D⁻¹ times the
    couplings of K across the axis (2 gᵃᵃ/h² for a continuous metric g). ``across`` is the least β such that the
    couplings C of M across the axis satisfy −C ⪯ βM; β is 1 for a constant metric, and 0 if the mass is lumped.
    """

    top: Any  # an upper bound on the eigenvalues of PK, where P ≈ M⁻¹
    low: Any  # a lower bound on the eigenvalues of D⁻¹M for the row sums D of M; 1 if the mass is lumped
    reach: Float[Array | np.ndarray, " d"]
    across: Float[Array | np.ndarray, " d"]
    least_mass: Any  # the least entry of D; for Fick's operator divided by the greatest √|D|, with the diffusivity D
    greatest_mass: Any  # the greatest entry of D, divided by the same number


@jax.jit
def mass_bound(pencil: Pencil) -> Float[Array, ""]:
    """Return a lower bound on the eigenvalues of D⁻¹M; 1 if the mass is lumped."""
    if isinstance(pencil.mass, DiagonalOperator):
        return jnp.ones((), pencil.mass.dtype)
    nodal = nodal_pencil(pencil)
    lumped, sums, mass = nodal.lumped[..., None], nodal.lumped_or_zero[..., None], nodal.mass.of_columns()

    def remainder(x: Array) -> Array:
        return sums * x - mass(x)

    greatest = lanczos_bound(remainder, lambda r: r / lumped, sums, pencil.space.n_dof, _MASS_STEPS)
    return jnp.clip(1 - greatest, 1e-3, 0.9)


@partial(jax.jit, static_argnames="mass_degree")
def bounds(pencil: Pencil, low: Float[Array, ""], mass_degree: int) -> Bounds:
    """Return the bounds of a pencil on a grid, given the bound ``low`` from `mass_bound`.

    The upper bound on the spectrum is a Lanczos estimate with a margin; for a lumped mass, at most Gershgorin's bound.
    """
    nodal, d = nodal_pencil(pencil), pencil.space.dimension
    entries, sums = nodal.stiffness.coefficients, nodal.lumped_or_zero
    solve_mass = nodal.mass_solve(low, mass_degree)
    offsets = np.array(list(product((-1, 0, 1), repeat=d)))
    measured = entries[None]
    if not nodal.mass.is_diagonal:
        # Without its couplings C across an axis, the mass M couples only nodes within layers perpendicular to the axis.
        # The matrix M − C consists of diagonal blocks of M, and so is positive semidefinite. If 1 + β is the greatest
        # eigenvalue of M⁻¹(M − C), the couplings C satisfy −C = (M − C) − M ⪯ βM.
        within = (offsets.T == 0).reshape(d, -1, *[1] * d)
        measured = jnp.concatenate([measured, jnp.where(within, nodal.mass.coefficients, 0)])

    def largest(matrix: Float[Array, "offsets *shape"]) -> Float[Array, ""]:
        apply = replace(nodal.stiffness, coefficients=matrix).of_columns()
        return lanczos_bound(apply, solve_mass, sums[..., None], pencil.space.n_dof, _STEPS)

    # A sequential map compiles the computation only once.
    top, *greatest = jax.lax.map(largest, measured)
    if nodal.mass.is_diagonal:
        top, across = jnp.minimum(top, gershgorin(entries, 1 / nodal.lumped)), jnp.zeros(d, sums.dtype)
    else:
        across = jnp.stack(greatest) - 1
    sizes = jnp.abs(entries) / nodal.lumped[None]
    reach = jnp.stack([jnp.max(jnp.sum(sizes[np.flatnonzero(offsets[:, a])], axis=0)) for a in range(d)])
    # The signature of Fick's operator is (4πt)^(−d/2)/√|D| at small times, and errors are relative to its least value.
    unit = 1 if pencil.density is None else jnp.max(pencil.density)
    return Bounds(top, low, reach, across, jnp.min(jnp.where(nodal.free, sums, jnp.inf)) / unit, jnp.max(sums) / unit)
