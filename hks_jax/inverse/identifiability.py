"""The information of data about the unknowns of a fit: the spectrum of JᵀJ, resolution, and uncertainty."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hks_jax.checks import require_count, require_number
from hks_jax.compilation import jit_quickly
from hks_jax.inverse.metric_fit import MetricFit
from hks_jax.inverse.problem import Problem
from hks_jax.inverse.unknowns import Values
from hks_jax.linear import lapack
from hks_jax.linear.chebyshev import chebyshev_recurrence

_ROUNDS = 4
"""Rounds of Chebyshev filtering for the weakest directions; each begins with the result of the last."""


class Identifiability(eqx.Module):
    """The directions that noisy data determine near a solution, to first order.

    With independent residuals of standard deviation σ the information about the unknowns is JᵀJ/σ². Against a prior of
    standard deviation τ, a direction v of JᵀJ with eigenvalue s² is determined by s²/(s² + σ²/τ²): near one by the
    data, near zero by the prior. The prior is white: it expects nothing of neighbours.

    Attributes:
        strengths: (n,) the largest eigenvalues s² of JᵀJ, descending; per unit of residual variance.
        directions: (n, *values) their eigenvectors, of length one.
        weak_strengths: (n_weak,) estimates from above of the smallest eigenvalues, ascending.
        weak_directions: (n_weak, *values) directions that the data hardly see.
        resolution: (nodes,) the share of each node's unknowns that the data determine: 0 … 1. A lower bound, by the n
            directions alone.
        deviation: (nodes,) the standard deviation of a node's unknowns (root mean square) that is left, by the n
            directions alone: an upper bound of that of the exact posterior, to first order, under a white prior
            (unknowns independent of each other, of standard deviation τ each). Under a prior that expects
            neighbours to be alike less is left.
        effective: the number of unknowns that the data determine, Σ s²/(s² + σ²/τ²) over the n directions.
        noise: σ.
        prior: τ.
    """

    strengths: Float[Array, " n"]
    directions: Float[Array, "n *values"]
    weak_strengths: Float[Array, " n_weak"]
    weak_directions: Float[Array, "n_weak *values"]
    resolution: Float[Array, " nodes"]
    deviation: Float[Array, " nodes"]
    effective: Float[Array, ""]
    noise: float = eqx.field(static=True)
    prior: float = eqx.field(static=True)

    def __repr__(self) -> str:
        top, bottom = float(self.strengths[0]), float(self.weak_strengths[0])
        return (
            f"Identifiability({float(self.effective):.1f} of {self.directions[0].size} unknowns seen by the "
            f"{len(self.strengths)} strongest directions; s² from {top:.2e} to at most {bottom:.2e})"
        )


def identifiability(
    fit: MetricFit | Problem,
    values: Values | None = None,
    n: int = 32,
    n_weak: int = 4,
    noise: float = 0.01,
    prior: float = 1.0,
    iterations: int = 4,
    seed: int = 0,
) -> Identifiability:
    """Find the directions that the data of a fit determine, by products with J and Jᵀ alone.

    The strongest directions come from randomised subspace iteration on JᵀJ (Halko, Martinsson and Tropp 2011), the
    weakest from the same on the complement, by Chebyshev polynomials that damp all that is strong. Isometries that the
    observation cannot tell are among the weak ones, and so are checkerboards and changes far from observed nodes.

    Args:
        fit: from `fit_metric`, or its problem.
        values: where to linearise; by default at the fit's solution.
        n: how many strong directions.
        n_weak: how many weak ones.
        noise: σ, the standard deviation of each entry's residual before weighting (0.01 for 1 % under ``"log"``).
        prior: τ, in the units of the parametrisation, of every unknown alone.
        iterations: of the subspace iteration; each takes n + 8 products with J and with Jᵀ.
        seed: of the random start.

    Returns:
        Spectrum, directions, resolution and uncertainty.

    Raises:
        ValueError: a problem without values, or n out of range.
    """
    problem = fit.problem if isinstance(fit, MetricFit) else fit
    values = fit.values if isinstance(fit, MetricFit) and values is None else values
    if values is None:
        raise ValueError("values: got None; a problem needs the values at which to linearise")
    total = values.size
    if not 1 <= n <= total or not 1 <= n_weak <= total:
        raise ValueError(f"n, n_weak: got {n}, {n_weak}; expected 1 … {total}, the number of unknowns")
    require_number("noise", noise)
    require_number("prior", prior)
    require_count("iterations", iterations)
    keys = jax.random.split(jax.random.key(seed))
    start = jax.random.normal(keys[0], (min(n + 8, total), *values.shape), values.dtype)
    strengths, directions = _strongest(problem, values, start, iterations)
    weak_start = jax.random.normal(keys[1], (min(n_weak + 4, total), *values.shape), values.dtype)
    weak, weak_directions = _weakest(problem, values, weak_start, strengths[0], 2 * iterations)

    # The weights add up to one over m entries: a residual of deviation σ has σ²/m after weighting, in the mean.
    variance = noise**2 / problem.observation.target.size
    strengths, directions = strengths[:n], directions[:n]
    share = strengths / (strengths + variance / prior**2)
    squares = directions.reshape(n, len(values), -1) ** 2
    resolution = jnp.einsum("n,nxc->x", share, squares) / squares.shape[2]
    return Identifiability(
        strengths,
        directions,
        weak[:n_weak],
        weak_directions[:n_weak],
        resolution,
        prior * jnp.sqrt(jnp.maximum(1 - resolution, 0)),
        jnp.sum(share),
        noise,
        prior,
    )


def _information(problem: Problem, values: Values) -> Any:
    """Return the product with JᵀJ of the data's residuals, for a batch of directions one after the other."""

    def data(values: Values) -> Array:
        return problem.observation.residuals(problem.pairs(values))

    _, product = jax.linearize(data, values)
    transposed = jax.linear_transpose(product, values)
    return lambda batch: jax.lax.map(lambda x: transposed(product(x))[0], batch)


@jit_quickly(eqx.filter_jit)
def _strongest(problem: Problem, values: Values, start: Array, iterations: int) -> tuple[Array, Array]:
    product = _information(problem, values)
    block = jax.lax.fori_loop(0, iterations, lambda _, block: _orthonormal(product(block)), _orthonormal(start))
    values, vectors = _ritz(block, product(block))
    return values[::-1], vectors[::-1]


@jit_quickly(eqx.filter_jit)
def _weakest(problem: Problem, values: Values, start: Array, top: Float[Array, ""], degree: int) -> tuple[Array, Array]:
    product = _information(problem, values)

    def improve(_: Any, state: tuple[Array, Array]) -> tuple[Array, Array]:
        values, block = state
        # A Chebyshev polynomial: small between the weak eigenvalues found so far and the top, growing below.
        cut = jnp.mean(values)
        centre, half = (1.1 * top + cut) / 2, (1.1 * top - cut) / 2

        def scaled(x: Array) -> Array:
            return (product(x) - centre * x) / half

        block, _, _ = chebyshev_recurrence(scaled, block, degree)
        block = _orthonormal(block)
        return _ritz(block, product(block))

    return jax.lax.fori_loop(0, _ROUNDS, improve, (jnp.full(len(start), 0.2 * top), _orthonormal(start)))


def _orthonormal(block: Float[Array, "n *values"]) -> Float[Array, "n *values"]:
    return lapack.orthonormal_columns(block.reshape(len(block), -1).T).T.reshape(block.shape)


def _ritz(block: Array, image: Array) -> tuple[Array, Array]:
    """Return Ritz values, ascending, and vectors in the span of orthonormal directions."""
    flat, images = block.reshape(len(block), -1), image.reshape(len(block), -1)
    projected = jnp.matmul(flat, images.T, precision="highest")
    values, mix = lapack.eigh((projected + projected.T) / 2)
    return values, jnp.matmul(mix.T, flat, precision="highest").reshape(block.shape)
