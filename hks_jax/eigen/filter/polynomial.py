"""Chebyshev polynomials of a pencil that damp the upper part of its spectrum."""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from hks_jax.compilation import jit_quickly
from hks_jax.fem.nodal import NodalPencil
from hks_jax.fem.stencil import Stencil
from hks_jax.linear.chebyshev import Columns, chebyshev_iteration, gershgorin, lanczos_bound
from hks_jax.linear.products import aligned

_STEPS = 64
"""The number of Lanczos steps for the upper bound of the spectrum."""
MOST_DEGREE = 1000
"""The maximal degree of a polynomial: enough for a band 10⁵ times as wide as the interval below the band."""


class Band(NamedTuple):
    """The interval of eigenvalues of D⁻¹K that a polynomial damps, where D is the lumped mass."""

    low: Float[Array, ""]
    high: Float[Array, ""]

    def degree_for(self, value: Float[Array, "*b"], gain: float) -> Float[Array, "*b"]:
        """Return the degree at which the polynomial equals ``gain`` at a value below the band.

        The degree is at most `MOST_DEGREE`. If a wide band needs a degree above `MOST_DEGREE`, pairs do not converge.
        """
        below = jnp.maximum(self.low - value, 0)
        degree = jnp.arccosh(jnp.asarray(gain, value.dtype)) / jnp.arccosh(1 + 2 * below / (self.high - self.low))
        return jnp.fmin(degree, MOST_DEGREE)  # the degree is NaN if the band is empty


# Let x be an approximate eigenvector with Rayleigh quotient λ and residual r = Kx − λMx. Let p be the Chebyshev
# polynomial with |p| ≤ 1 on the damped band; p grows fast below the band. Then p(M⁻¹K)x/p(λ) is x plus a correction,
#
#     x + q(M⁻¹K) M⁻¹r,    q(z) = (p(z)/p(λ) − 1)/(z − λ),
#
# in which M⁻¹ acts only on the residual. So an approximate inverse of M, or single precision, does not change the limit
# of the iteration (residual-based filtering, R-ChFSI). Let the lumped mass D replace M, and let D⁻¹M multiply an
# eigenvector with eigenvalue μ by β < 1. In the correction with D, the argument z of q becomes βμ, and D⁻¹r contains
# the eigenvector with the factor β(μ − λ), while q assumes the factor z − λ. Both factors agree up to second order in
# h²λ, where h is the node spacing, if the lumped quotient ζ = xᵀKx / xᵀDx replaces λ in q and the correction is scaled
# by ζ/λ: for β(μ) ≈ 1 − ch²μ,
#
#     z − ζ = (μ − λ)(β − ch²λ + …) = β(μ − λ) · ζ/λ + ….
#
# If the mesh is coarse in one direction only, the factor β also depends on the direction of an eigenvector, and the
# values βμ near the edge of the band may have another order than the eigenvalues μ. If the mesh is too coarse for the
# wanted eigenvectors, others with β ≈ 3⁻ᵈ in d dimensions and much larger μ have smaller values βμ. For such coarse
# meshes, W = Σⱼ (I − D⁻¹M)ʲ D⁻¹ replaces D⁻¹, which adds n terms of the Neumann series of M⁻¹. With W, the eigenvalue
# βμ of D⁻¹K becomes the eigenvalue ψ = (1 − (1 − β)ⁿ⁺¹)μ of WK, at most n + 1 times as large. Since the derivative
# dψ/dμ is 1 − (n + 2)(1 − β)ⁿ⁺¹, the scale ζ/λ of the correction becomes 1 − (n + 1)(1 − β)ⁿ⁺¹.
#
# W may replace D⁻¹ everywhere. Since the polynomial q is negative on both sides of ζ, −q(D⁻¹K)D⁻¹ is also a symmetric
# positive definite preconditioner for K − λM.
def correction(
    pencil: NodalPencil,
    band: Band,
    residual: Columns,
    value: Float[Array, " b"],
    degree: Int[Array, ""],
    whole: Columns | float = 0.0,
    terms: Int[Array, ""] | int = 0,
) -> Columns:
    """Return the correction q(D⁻¹K) D⁻¹r for each residual r, where q is defined by ζ = min(``value``, ``band.low``).

    If n = ``terms`` > 0, W replaces D⁻¹, and ``value`` and ``band`` refer to eigenvalues of WK. If a column x of
    ``whole`` is not zero, the corresponding column of ``residual`` must be Kx, and D⁻¹Kx − ζx replaces D⁻¹r, so that x
    plus the result is the filtered vector p(D⁻¹K)x / p(ζ).
    """
    dtype, reference = residual.dtype, jnp.minimum(value, band.low)

    def scaled(matrix: Stencil) -> Callable[[Columns], Columns]:
        return replace(matrix, coefficients=(matrix.coefficients / pencil.lumped[None]).astype(dtype)).of_columns()

    stiffness = scaled(pencil.stiffness)

    def run(inverse: Callable[[Columns], Columns]) -> Columns:
        w = inverse(residual / pencil.lumped[..., None].astype(dtype))
        w = w - aligned(reference.astype(dtype), residual) * whole
        return chebyshev_iteration(lambda z: inverse(stiffness(z)), w, band.low, band.high, reference, degree)

    def by_lumping() -> Columns:
        return run(lambda y: y)

    def by_series() -> Columns:
        mass = scaled(pencil.mass)
        return run(lambda y: jax.lax.fori_loop(0, terms, lambda _, sum_: y + (sum_ - mass(sum_)), y))

    # Lumping is compiled separately, so that XLA fuses a whole step of the Chebyshev iteration.
    return by_lumping() if pencil.mass.is_diagonal else jax.lax.cond(jnp.asarray(terms) > 0, by_series, by_lumping)


@jit_quickly()
def upper_end(pencil: NodalPencil) -> Float[Array, ""]:
    """Return an upper bound of the spectrum of D⁻¹K, where D is the lumped mass."""
    lumped, sums = pencil.lumped[..., None], pencil.lumped_or_zero[..., None]
    bound = lanczos_bound(pencil.stiffness.of_columns(), lambda r: r / lumped, sums, sums.size, _STEPS)
    # Gershgorin's bound always holds, but may be twice too large if tensors vary.
    return jnp.minimum(bound, gershgorin(pencil.stiffness.coefficients, 1 / pencil.lumped))
