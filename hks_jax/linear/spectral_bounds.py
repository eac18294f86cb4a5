"""Upper bounds on the spectrum of D⁻¹K and of PK, K and P symmetric and not negative."""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hks_jax.linear import lapack

_FAILURE = 1e-6
_START = 30
"""How far from uniform the start may be: the root of the condition of PD and more."""


@jax.jit
def gershgorin(entries: Float[Array, "offsets *shape"], inverse: Float[Array, "*shape"]) -> Float[Array, ""]:
    """Return the bound of Gershgorin's discs, which never fails, on D⁻¹K: K's entries row by row, and D⁻¹."""
    return jnp.max(jnp.sum(jnp.abs(entries), axis=0) * inverse)


def lanczos_bound(
    apply: Callable[[Array], Array], solve: Callable[[Array], Array], sums: Float[Array, "..."], n: int, steps: int
) -> Float[Array, ""]:
    """Return an upper bound on the eigenvalues of PK by Lanczos iteration.

    From a random start the largest Ritz value θ of k steps satisfies λ(1 − ε) ≤ θ ≤ λ but for a probability of
    1.648 √n exp(−√ε (2k − 1)) (Kuczyński and Woźniakowski 1992, theorem 4.2): θ/(1 − ε) is returned for the ε that
    makes this 10⁻⁶. The start is normal in the coordinates of D, not quite those of P, which is allowed for.

    Args:
        apply: x ↦ Kx.
        solve: r ↦ Pr.
        sums: D ≈ P⁻¹, a diagonal; 0 where there is no degree of freedom. Of the shape of x.
        n: how many degrees of freedom there are.
        steps: k.
    """
    r = jnp.sqrt(sums) * jax.random.normal(jax.random.key(0), sums.shape, sums.dtype)

    def step(state: tuple[Array, Array, Array], _: None) -> tuple[tuple[Array, Array, Array], tuple[Array, Array]]:
        v, r, size = state
        z = solve(r)
        following = jnp.sqrt(jnp.maximum(jnp.vdot(r, z), 0))
        # The Krylov space may be exhausted: zeros from there on add zeros to the Ritz values.
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
    if steps >= n:  # the whole space was seen
        epsilon = 1e-3
    return lapack.eigh(matrix)[0][-1] / (1 - epsilon)
