"""Bounds on the spectra that polynomials are built for, and on how fast heat travels along an axis."""

import math
from collections.abc import Callable
from functools import partial
from itertools import product
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.fem.operators import DiagonalOperator
from hks_jax.fem.pencil import Pencil
from hks_jax.spectrum_free.heat_operator import heat_operator

_STEPS, _MASS_STEPS = 50, 200
_FAILURE = 1e-6
_START = 30
"""How far from uniform the start may be: the root of the condition of D⁻¹M and more."""


class Bounds(NamedTuple):
    """What a pencil's polynomials must be fit for.

    Attributes:
        top: an upper bound on the eigenvalues of PK.
        low: a lower bound on those of D⁻¹M, D the row sums of M; 1 if lumped.
        reach: (d,) per axis, a bound on the eigenvalues of D⁻¹ times the couplings of K across the axis. The discrete
            counterpart of 2 gᵃᵃ/h².
        least_mass: the least entry of D.
        greatest_mass: the greatest.
    """

    top: Float[Array, ""]
    low: Float[Array, ""]
    reach: Float[Array, " d"]
    least_mass: Float[Array, ""]
    greatest_mass: Float[Array, ""]


@jax.jit
def mass_bound(pencil: Pencil) -> Float[Array, ""]:
    """Return a lower bound on the eigenvalues of D⁻¹M; 1 if the mass is lumped."""
    if isinstance(pencil.mass, DiagonalOperator):
        return jnp.ones((), pencil.mass.dtype)
    operator = heat_operator(pencil)
    scaled = operator.inverse_row_sums[..., None]
    sums = jnp.where(scaled > 0, 1 / jnp.where(scaled > 0, scaled, 1), 0)

    products = operator.products()

    def rest(x: Array) -> Array:
        return sums * x - products.apply_mass(x)

    greatest = _largest(rest, lambda r: scaled * r, sums, pencil.space.n_dof, _MASS_STEPS)
    return jnp.clip(1 - greatest, 1e-3, 0.9)


@partial(jax.jit, static_argnames="mass_degree")
def bounds(pencil: Pencil, low: Float[Array, ""], mass_degree: int) -> Bounds:
    """Return the bounds of a pencil on a grid, given `mass_bound`.

    The top is Gershgorin's where that is less than a Lanczos estimate with its margin.
    """
    operator = heat_operator(pencil, low, mass_degree)
    inverse = operator.inverse_row_sums
    d, free = pencil.space.dimension, pencil.space.free
    sums = jnp.where(free, 1 / jnp.where(free, inverse, 1), 0)
    products = operator.products()
    top = _largest(products.apply_stiffness, products.solve_mass, sums[..., None], pencil.space.n_dof, _STEPS)
    sizes = jnp.abs(operator.stiffness) * inverse
    if operator.lumped:
        top = jnp.minimum(top, jnp.max(jnp.sum(sizes, axis=0)))
    offsets = np.array(list(product((-1, 0, 1), repeat=d)))
    reach = jnp.stack([jnp.max(jnp.sum(sizes[np.flatnonzero(offsets[:, a])], axis=0)) for a in range(d)])
    return Bounds(top, low, reach, jnp.min(jnp.where(free, sums, jnp.inf)), jnp.max(sums))


def _largest(
    apply: Callable[[Array], Array], solve: Callable[[Array], Array], sums: Array, n: int, steps: int
) -> Float[Array, ""]:
    """Return an upper bound on the eigenvalues of PB, B and P symmetric and not negative, by Lanczos iteration.

    From a random start the largest Ritz value θ of k steps satisfies λ(1 − ε) ≤ θ ≤ λ but for a probability of
    1.648 √n exp(−√ε (2k − 1)) (Kuczyński and Woźniakowski 1992, theorem 4.2): θ/(1 − ε) is returned for the ε that
    makes this 10⁻⁶. The start is normal in the coordinates of D, not quite those of P, which is allowed for.
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
    return jnp.linalg.eigvalsh(matrix)[-1] / (1 - epsilon)
