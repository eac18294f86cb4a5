"""Chebyshev polynomials of a pencil that damp the upper part of its spectrum."""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from hks_jax.fem.nodal import NodalPencil
from hks_jax.linear.chebyshev import Columns, chebyshev_iteration, gershgorin, lanczos_bound
from hks_jax.linear.products import aligned

_STEPS = 64
"""Lanczos steps for the upper end of the spectrum."""
MOST_DEGREE = 1000
"""Enough for a band a hundred thousand times as wide as what is below it."""


class Band(NamedTuple):
    """The interval of D⁻¹K whose modes are damped, D the lumped mass."""

    low: Float[Array, ""]
    high: Float[Array, ""]

    def degree_for(self, value: Float[Array, "*b"], gain: float) -> Float[Array, "*b"]:
        """Return the degree at which the polynomial is ``gain`` at a value below the band: gain = cosh(degree · a).

        At most `MOST_DEGREE`: where the band is so wide that more is needed, pairs do not converge, which is told.
        """
        below = jnp.maximum(self.low - value, 0)
        degree = jnp.arccosh(jnp.asarray(gain, value.dtype)) / jnp.arccosh(1 + 2 * below / (self.high - self.low))
        return jnp.fmin(degree, MOST_DEGREE)  # not NaN either, where the band is empty


# Let x be an approximate eigenvector with Rayleigh quotient λ and residual r = Kx − λMx, and p the Chebyshev polynomial
# that is at most 1 on the band and grows fast below it. Damping x by p(M⁻¹K)/p(λ) can be written as a correction,
#
#     x + q(M⁻¹K) M⁻¹r,    q(z) = (p(z)/p(λ) − 1)/(z − λ),
#
# in which M⁻¹ acts on the residual only: an approximate inverse leaves the limit exact, and so does single precision
# (residual-based filtering, R-ChFSI). With the lumped mass D for M, a mode of eigenvalue μ, and of ratio β = D⁻¹M < 1,
# has z = βμ and its part in D⁻¹r is β(μ − λ) instead of z − λ. The two agree to second order in h²λ if λ is replaced
# by the lumped quotient ζ = xᵀKx / xᵀDx and the correction is scaled by ζ/λ: for β(μ) ≈ 1 − ch²μ,
#
#     z − ζ = (μ − λ)(β − ch²λ + …) = β(μ − λ) · λ/ζ + ….
#
# Where the mesh is coarse in one direction only, β depends on the direction of a mode as well, and near the edge of the
# band the order by βμ may not be that by μ; where it is coarse for the wanted modes altogether, modes of many times
# their eigenvalues, β ≈ 3⁻ᵈ, come before them. Then W = Σⱼ (I − D⁻¹M)ʲ D⁻¹, n more terms of Neumann's series, takes
# the place of D⁻¹: βμ becomes ψ = (1 − (1 − β)ⁿ⁺¹)μ, at most n + 1 times as large, and as dψ/dμ = 1 − (n + 2)(1 − β)ⁿ⁺¹
# the scale ζ/λ becomes 1 − (n + 1)(1 − β)ⁿ⁺¹.
#
# D⁻¹ may be W throughout. q < 0 on both sides of ζ, so that −q(D⁻¹K)D⁻¹ is also a symmetric positive definite
# preconditioner for K − λM.
def correction(
    pencil: NodalPencil,
    band: Band,
    residual: Columns,
    value: Float[Array, " b"],
    degree: Int[Array, ""],
    whole: Columns | float = 0.0,
    terms: Int[Array, ""] | int = 0,
) -> Columns:
    """Return q(D⁻¹K) D⁻¹ residual with the polynomial that belongs to ``value`` ζ (at most the band's low end).

    With ``terms`` n > 0, W in place of D⁻¹; value and band are then those of WK. Where a column of ``whole`` is not
    zero it is x, the residual's is Kx, and p(D⁻¹K)/p(ζ) damps x as it is: D⁻¹Kx − ζx takes the place of D⁻¹r.
    """
    dtype = residual.dtype
    stiffness, mass = (
        replace(matrix, coefficients=(matrix.coefficients / pencil.lumped[None]).astype(dtype)).of_columns()
        for matrix in (pencil.stiffness, pencil.mass)
    )

    def further(y: Columns) -> Columns:
        if pencil.mass.is_diagonal:
            return y
        return jax.lax.fori_loop(0, terms, lambda _, sum_: y + (sum_ - mass(sum_)), y)

    reference = jnp.minimum(value, band.low)

    def run(inverse: Callable[[Array], Array]) -> Columns:
        w = inverse(residual / pencil.lumped[..., None].astype(dtype)) - aligned(reference.astype(dtype), whole) * whole
        return chebyshev_iteration(lambda z: inverse(stiffness(z)), w, band.low, band.high, reference, degree)

    # Apart, so that without further terms all of a step is one computation.
    return jax.lax.cond(jnp.asarray(terms) > 0, lambda: run(further), lambda: run(lambda y: y))


@jax.jit
def upper_end(pencil: NodalPencil) -> Float[Array, ""]:
    """Return a bound of the spectrum of D⁻¹K."""
    lumped, sums = pencil.lumped[..., None], pencil.lumped_or_zero[..., None]
    bound = lanczos_bound(pencil.stiffness.of_columns(), lambda r: r / lumped, sums, sums.size, _STEPS)
    # Gershgorin's discs never fail, but are twice too large where tensors vary.
    return jnp.minimum(bound, gershgorin(pencil.stiffness.coefficients, 1 / pencil.lumped))
