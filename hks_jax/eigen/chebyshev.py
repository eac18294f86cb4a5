"""Chebyshev polynomials of a pencil that damp the upper part of its spectrum."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from hks_jax.eigen.coarsening import Level
from hks_jax.fem.columns import stencil, stencil_product

_STEPS = 16
"""Lanczos steps for the upper end of the spectrum."""
_MARGIN = 1.03
"""What the upper end may be underestimated by."""


class Band(NamedTuple):
    """The interval of D⁻¹K whose modes are damped, D the lumped mass."""

    low: Float[Array, ""]
    high: Float[Array, ""]


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
# With the three-term recurrence of p in s(z) = (z − c)/e, c and e the band's centre and half width, and z_j = q_j w,
# w = D⁻¹r, everything divided by p_j(ζ), whose ratios are σ_j = p_j(ζ)/p_{j+1}(ζ) = 1/(2s(ζ) − σ_{j−1}):
#
#     z_{j+1} = (2σ_j/e) ((D⁻¹K − c) z_j + w) − σ_j σ_{j−1} z_{j−1},    z_0 = 0,   z_1 = (σ_0/e) w,   σ_0 = 1/s(ζ).
#
# D⁻¹ may be W throughout. q < 0 on both sides of ζ, so that −q(D⁻¹K)D⁻¹ is also a symmetric positive definite
# preconditioner for K − λM.
def correction(
    level: Level,
    periodic: tuple[bool, ...],
    band: Band,
    residual: Float[Array, "*shape b"],
    value: Float[Array, " b"],
    degree: Int[Array, ""],
    whole: Float[Array, "*shape b"] | float = 0.0,
    terms: Int[Array, ""] | int = 0,
) -> Float[Array, "*shape b"]:
    """Return q(D⁻¹K) D⁻¹ residual with the polynomial that belongs to ``value`` ζ (at most the band's low end).

    With ``terms`` n > 0, W in place of D⁻¹; value and band are then those of WK. Where a column of ``whole`` is not
    zero it is x, the residual's is Kx, and p(D⁻¹K)/p(ζ) damps x as it is: D⁻¹Kx − ζx takes the place of D⁻¹r.
    """
    dtype = residual.dtype
    centre, half = (band.high + band.low) / 2, (band.high - band.low) / 2
    stiffness = stencil((level.stiffness / level.lumped).astype(dtype), periodic)
    mass = stencil((level.mass / level.lumped).astype(dtype), periodic)

    def further(y: Float[Array, "*shape b"]) -> Float[Array, "*shape b"]:
        if level.mass.shape[0] == 1:
            return y
        return jax.lax.fori_loop(0, terms, lambda _, sum_: y + (sum_ - mass(sum_)), y)

    reference = jnp.minimum(value, band.low)
    s = (reference - centre) / half

    def run(inverse: Callable[[Array], Array]) -> Float[Array, "*shape b"]:
        w = inverse(residual / level.lumped[..., None].astype(dtype)) - reference.astype(dtype) * whole

        def step(_: Int[Array, ""], state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            before, z, ratio = state
            following = 1 / (2 * s - ratio)
            grown = inverse(stiffness(z)) - centre.astype(dtype) * z + w
            after = (2 * following / half).astype(dtype) * grown - (following * ratio).astype(dtype) * before
            return z, after, following

        first = jnp.zeros_like(w), (1 / (s * half)).astype(dtype) * w, 1 / s
        return jax.lax.fori_loop(1, degree, step, first)[1]

    # Apart, so that without further terms all of a step is one computation.
    return jax.lax.cond(jnp.asarray(terms) > 0, lambda: run(further), lambda: run(lambda y: y))


def degree_for(band: Band, value: Float[Array, "*b"], gain: float) -> Float[Array, "*b"]:
    """Return the degree at which the polynomial is ``gain`` at a value below the band: gain = cosh(degree · a)."""
    below = jnp.maximum(band.low - value, 0)
    return jnp.arccosh(jnp.asarray(gain, value.dtype)) / jnp.arccosh(1 + 2 * below / (band.high - band.low))


@partial(jax.jit, static_argnames="periodic")
def upper_end(level: Level, periodic: tuple[bool, ...]) -> Float[Array, ""]:
    """Return a bound of the spectrum of D⁻¹K: a few steps of Lanczos, and the residual (Zhou and Li 2011)."""
    dtype = level.lumped.dtype
    start = jnp.where(level.free, jax.random.normal(jax.random.key(1), level.shape, dtype), 0)[..., None]

    def norm(x: Array) -> Array:
        return jnp.sqrt(jnp.sum(level.lumped[..., None] * x * x))

    def step(state: tuple[Array, Array, Array], _: None) -> tuple[tuple[Array, Array, Array], tuple[Array, Array]]:
        before, x, beta = state
        y = stencil_product(level.stiffness, x, periodic) / level.lumped[..., None] - beta * before
        alpha = jnp.sum(level.lumped[..., None] * x * y)
        y = y - alpha * x
        beta = norm(y)
        return (x, y / jnp.where(beta > 0, beta, 1), beta), (alpha, beta)

    first = jnp.zeros_like(start), start / norm(start), jnp.zeros((), dtype)
    _, (alpha, beta) = jax.lax.scan(step, first, None, length=_STEPS)
    tridiagonal = jnp.diag(alpha) + jnp.diag(beta[:-1], 1) + jnp.diag(beta[:-1], -1)
    values, vectors = jnp.linalg.eigh(tridiagonal)
    bound = values[-1] + beta[-1] * jnp.abs(vectors[-1, -1])
    # Gershgorin's discs never fail, but are twice too large where tensors vary.
    discs = jnp.max(jnp.sum(jnp.abs(level.stiffness), axis=0) / level.lumped)
    return jnp.minimum(_MARGIN * bound, discs)
