"""Matrix-free Chebyshev polynomials of a matrix, the Chebyshev expansion of exp(−tλ), and bounds of spectra."""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float, Int

from hks_jax.arrays import Scalar
from hks_jax.linear import accelerators, lapack
from hks_jax.linear.products import aligned, matmul

_FAILURE = 1e-6
_START = 30
"""The safety factor of `lanczos_bound` for start vectors with covariance D instead of P⁻¹, at least √cond(PD)."""

Columns = Float[Array, "*shape b"]
Step = tuple[Columns, Columns, Array, Array, Array]
"""The vectors z_{j−1} and z_j, their factors 2σ_j/e and σ_j σ_{j−1} in the next step, and σ_j."""


def chebyshev_recurrence(
    product: Callable[[Any], Any],  # y ↦ Ay, where the spectrum of A lies in [−1, 1]
    x: Any,  # an array, or a tree of arrays
    degree: int,  # at least 1; static
    total: Any = (),  # the initial value of the accumulated sum
    add: Callable[[Any, Any, Any], Any] = lambda n, y, total: total,  # (n, yₙ, sum) ↦ the sum plus the n-th term
) -> tuple[Any, Any, Any]:
    """Compute the vectors yₙ = Tₙ(A)x for n ≤ degree by the three-term recurrence; return the last two and the sum."""

    def step(n: Array, state: tuple) -> tuple:
        y, before, total = state
        total = add(n, y, total)
        factor = jnp.where(n == 0, 1, 2)
        following = jax.tree.map(lambda image, y: factor.astype(y.dtype) * image - y, product(y), before)
        return following, y, total

    y, before, total = jax.lax.fori_loop(0, degree, step, (x, jax.tree.map(jnp.zeros_like, x), total))
    return y, before, add(degree, y, total)


# Let p_j(z) = T_j(s(z)) be the Chebyshev polynomials of an interval: s(z) = (z − c)/e, where c is the interval's centre
# and e is its half width. If the three-term recurrence of the polynomials is divided by the number p_{j+1}(ζ), the
# recurrence of the vectors z_j = q_j(A) w follows, where q_j(z) = (p_j(z)/p_j(ζ) − 1)/(z − ζ):
#
#     z_{j+1} = (2σ_j/e) ((A − c) z_j + w) − σ_j σ_{j−1} z_{j−1},    z_0 = 0,    z_1 = (σ_0/e) w.
#
# The coefficients are the quotients σ_j = p_j(ζ)/p_{j+1}(ζ) = 1/(2s(ζ) − σ_{j−1}), where σ_0 = 1/s(ζ).
# `chebyshev_recurrence` computes the vector p(A)w instead, and would overflow if the number ζ is far from the interval.
def chebyshev_iteration(
    product: Callable[[Columns], Columns],  # x ↦ Ax
    w: Columns,
    low: Scalar,
    high: Scalar,
    value: Float[Array, "*b"] | float,  # the number ζ outside the interval, for each column or for all
    degree: Int[Array, ""] | int,  # the degree of p
) -> Columns:
    """Return q(A)w, where q(z) = (p(z)/p(ζ) − 1)/(z − ζ) and p is the Chebyshev polynomial of [low, high].

    If the spectrum of A lies in the interval, Chebyshev iteration for the system (A − ζ)x = w gives the solution
    −q(A)w, whose residual is p(A)w/p(ζ).
    """
    centre, half = (high + low) / 2, (high - low) / 2
    s = aligned((value - centre) / half, w)

    def factors(twice: Array | int, following: Array, ratio: Array) -> tuple[Array, Array]:
        return (twice * following / half).astype(w.dtype), (following * ratio).astype(w.dtype)

    # A step computes the factors of the next one. If a step computed its own, XLA would divide for each entry of z.
    def step(state: Step) -> Step:
        before, z, grow, back, ratio = state
        after = grow * (product(z) - centre.astype(w.dtype) * z + w) - back * before
        following = 1 / (2 * s - ratio)
        return z, after, *factors(2, following, ratio), following

    # On accelerators, each loop iteration takes two steps, so that new vectors overwrite old ones; with one step, XLA
    # would copy both vectors. If the number of steps is odd, an additional first step leads from z₀ = 0 to z₁.
    together = 2 if accelerators.at_hand() else 1
    missing = jnp.asarray((degree - 1) % together)

    def turn(number: Array, state: Step) -> Step:
        for _ in range(together):
            state = step(state)
        return state

    twice = 2 - missing.astype(s.dtype)
    ratio = (twice - 1) / s
    following = 1 / (twice * s - ratio)
    first = jnp.zeros_like(w), (ratio / half).astype(w.dtype) * w, *factors(twice, following, ratio), following
    return jax.lax.fori_loop(0, (degree - 1 + missing) // together, turn, first)[1]


# On 0 ≤ λ ≤ top, exp(−tλ) has the Chebyshev coefficients e^(−z) I₀(z) and 2 (−1)ⁿ e^(−z) Iₙ(z), where z = t·top/2.
@partial(jax.jit, static_argnames="degree")
def chebyshev_heat_coefficients(
    times: Float[Array, " m"], top: Scalar | float, degree: int
) -> Float[Array, "m {degree}+1"]:
    """Return the Chebyshev coefficients of exp(−tλ), by a cosine transform of samples, which JAX can differentiate."""
    samples = degree + 32 + 4 * math.isqrt(degree)  # aliased coefficients have degrees ≥ 2·samples − degree
    angles = (np.arange(samples) + 0.5) * (np.pi / samples)
    weights = np.cos(np.outer(angles, np.arange(degree + 1))) * (2 / samples)
    weights[:, 0] /= 2
    values = jnp.exp(-times[:, None] * top * jnp.asarray((1 + np.cos(angles)) / 2, times.dtype)[None])
    return matmul(values, jnp.asarray(weights, times.dtype))


def coefficient_tails(z: float) -> Float[np.ndarray, " n_and_1"]:
    """Return, for each n, the sum of the absolute values of the n-th and all later Chebyshev coefficients of exp(−tλ).

    For the interval 0 ≤ λ ≤ top, the argument z is t·top/2. Coefficients below 1e-25 are omitted. The last sum is 0.
    """
    n = np.arange(int(math.sqrt(2 * z * 60) + 60) + 1)
    sizes = np.where(n == 0, 1, 2) * scipy.special.ive(n, z)
    return np.append(np.cumsum(sizes[::-1])[::-1], 0)


def least_degree(z: float, error: float) -> int:
    """Return the least degree ≥ 1 for which the omitted coefficients sum to at most the error."""
    return max(int(np.argmax(coefficient_tails(z) <= error)) - 1, 1)


@jax.jit
def gershgorin(entries: Float[Array, "offsets *shape"], inverse: Float[Array, "*shape"]) -> Float[Array, ""]:
    """Return the Gershgorin bound of the spectrum of D⁻¹K, given the entries of K row by row, and the diagonal D⁻¹."""
    return jnp.max(jnp.sum(jnp.abs(entries), axis=0) * inverse)


def lanczos_bound(
    apply: Callable[[Array], Array],  # x ↦ Kx
    solve: Callable[[Array], Array],  # r ↦ Pr
    sums: Float[Array, "..."],  # a diagonal approximation D of P⁻¹; 0 at nodes that are not free
    n: int,  # the number of degrees of freedom
    steps: int,
) -> Scalar:
    """Return an upper bound of the eigenvalues of PK by Lanczos iteration.

    After k steps from a random vector, the largest Ritz value θ and the largest eigenvalue λ satisfy λ(1 − ε) ≤ θ ≤ λ
    with probability at least 1 − 1.648 √n exp(−√ε (2k − 1)) (Kuczyński and Woźniakowski 1992, theorem 4.2). The result
    is θ/(1 − ε), where ε is such that the result is below λ with probability at most 10⁻⁶. The random vector has
    covariance D instead of P⁻¹; a safety factor compensates for the difference.
    """
    r = jnp.sqrt(sums) * jax.random.normal(jax.random.key(0), sums.shape, sums.dtype)

    def step(state: tuple[Array, Array, Array], _: None) -> tuple[tuple[Array, Array, Array], tuple[Array, Array]]:
        v, r, size = state
        z = solve(r)
        following = jnp.sqrt(jnp.maximum(jnp.vdot(r, z), 0))
        # If the Krylov space is exhausted, all further coefficients are zero, which adds only zero Ritz values.
        alive = following > 1e-5 * size
        scale = jnp.where(alive, 1 / jnp.where(alive, following, 1), 0)
        w, z = scale * r, scale * z
        image = apply(z)
        alpha = jnp.vdot(image, z)
        beta = jnp.where(alive, following, 0)
        following_r = image - alpha * w - beta * v
        return (w, following_r, jnp.maximum(size, alpha)), (alpha, beta)

    start = jnp.zeros_like(r), r / jnp.sqrt(jnp.vdot(r, solve(r))), jnp.zeros((), r.dtype)
    _, (alpha, beta) = jax.lax.scan(step, start, length=steps)
    matrix = jnp.diag(alpha) + jnp.diag(beta[1:], 1) + jnp.diag(beta[1:], -1)
    epsilon = (math.log(1.648 * _START * math.sqrt(n) / _FAILURE) / (2 * steps - 1)) ** 2
    if steps >= n:  # the Krylov space is the whole space
        epsilon = 1e-3
    return lapack.eigh(matrix)[0][-1] / (1 - epsilon)
