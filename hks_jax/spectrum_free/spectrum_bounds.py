"""Bounds on the spectra that polynomials are built for, and on how fast heat travels along an axis."""

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
    """What a pencil's polynomials must be fit for; once known, NumPy's numbers in double precision.

    Attributes:
        top: an upper bound on the eigenvalues of PK.
        low: a lower bound on those of D⁻¹M, D the row sums of M; 1 if lumped.
        reach: (d,) per axis, a bound on the eigenvalues of D⁻¹ times the couplings of K across the axis. The discrete
            counterpart of 2 gᵃᵃ/h².
        across: (d,) per axis, the least β for which the couplings C of M across the axis satisfy −C ⪯ βM; 0 if lumped.
            It is 1 for a constant metric.
        least_mass: the least entry of D.
        greatest_mass: the greatest.
    """

    top: Any
    low: Any
    reach: Float[Array | np.ndarray, " d"]
    across: Float[Array | np.ndarray, " d"]
    least_mass: Any
    greatest_mass: Any


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
    """Return the bounds of a pencil on a grid, given `mass_bound`.

    The top is Gershgorin's where that is less than a Lanczos estimate with its margin.
    """
    nodal, d = nodal_pencil(pencil), pencil.space.dimension
    entries, sums = nodal.stiffness.coefficients, nodal.lumped_or_zero
    solve_mass = nodal.mass_solve(low, mass_degree)
    offsets = np.array(list(product((-1, 0, 1), repeat=d)))
    measured = entries[None]
    if not nodal.mass.is_diagonal:
        measured = jnp.concatenate([measured, _within_lines(nodal.mass.coefficients, offsets)])

    def largest(matrix: Float[Array, "offsets *shape"]) -> Float[Array, ""]:
        apply = replace(nodal.stiffness, coefficients=matrix).of_columns()
        return lanczos_bound(apply, solve_mass, sums[..., None], pencil.space.n_dof, _STEPS)

    # One after the other: side by side they would be compiled as many times.
    top, *greatest = jax.lax.map(largest, measured)
    if nodal.mass.is_diagonal:
        top, across = jnp.minimum(top, gershgorin(entries, 1 / nodal.lumped)), jnp.zeros(d, sums.dtype)
    else:
        across = jnp.stack(greatest) - 1
    sizes = jnp.abs(entries) / nodal.lumped[None]
    reach = jnp.stack([jnp.max(jnp.sum(sizes[np.flatnonzero(offsets[:, a])], axis=0)) for a in range(d)])
    return Bounds(top, low, reach, across, jnp.min(jnp.where(nodal.free, sums, jnp.inf)), jnp.max(sums))


# M − C, the couplings within the lines of nodes that cross the axis at right angles, is a diagonal of blocks of M and
# so not negative, and −C = (M − C) − M ⪯ βM with 1 + β the greatest eigenvalue of M⁻¹(M − C).
def _within_lines(mass: Float[Array, "offsets *shape"], offsets: np.ndarray) -> Float[Array, "d offsets *shape"]:
    """Return the M − C of each axis for a consistent mass."""
    d = offsets.shape[1]
    return jnp.where((offsets.T == 0).reshape(d, -1, *[1] * d), mass, 0)
