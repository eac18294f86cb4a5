"""The information of data about the unknowns of a fit: the eigenpairs of JᵀJ for the data's Jacobian J."""

from collections.abc import Callable
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
"""The number of rounds of Chebyshev-filtered subspace iteration for the smallest eigenvalues of JᵀJ."""


class Identifiability(eqx.Module):
    """The combinations of unknowns that noisy data determine, from a linearisation of the data at a solution.

    For m observed entries with independent noise of standard deviation σ, the information about the unknowns is m
    JᵀJ/σ², where J is the Jacobian of the weighted residuals. With a prior of standard deviation τ, the data determine
    the share s²/(s² + σ²/(mτ²)) of an eigenvector of JᵀJ with the eigenvalue s², and the prior determines the rest. The
    prior is white, so unknowns at neighbouring nodes are a priori independent.

    Attributes:
        strengths: (n,) the largest eigenvalues s² of JᵀJ in descending order.
        directions: (n, *values) the normalised eigenvectors of JᵀJ for the eigenvalues in `strengths`.
        weak_strengths: (n_weak,) upper bounds on the smallest eigenvalues of JᵀJ in ascending order.
        weak_directions: (n_weak, *values) the combinations of unknowns that the data determine least.
        resolution: (nodes,) the share of each node's unknowns that data determine; a lower bound from n eigenvectors.
        deviation: (nodes,) the posterior standard deviation of each node's unknowns (root mean square); an upper bound
            from n eigenvectors. A prior that correlates neighbouring nodes would give smaller standard deviations.
        effective: the number of unknowns that data determine, as the sum of the determined shares of n eigenvectors.
        noise: the standard deviation σ of the residuals before weighting.
        prior: the standard deviation τ of the prior.
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
            f"Identifiability({float(self.effective):.1f} of {self.directions[0].size} unknowns determined by the "
            f"{len(self.strengths)} strongest directions; s² from {top:.2e} to at most {bottom:.2e})"
        )


def identifiability(
    fit: MetricFit | Problem,
    values: Values | None = None,
    *,
    n: int = 32,
    n_weak: int = 4,
    noise: float = 0.01,
    prior: float = 1.0,
    iterations: int = 4,
    seed: int = 0,
) -> Identifiability:
    """Find the combinations of unknowns that the data of a fit determine best and least.

    Each combination is an eigenvector of JᵀJ, where J is the Jacobian of the data. Randomised subspace iteration
    computes the largest eigenvalues (Halko, Martinsson and Tropp 2011). Subspace iteration with Chebyshev polynomials
    that damp large eigenvalues computes the smallest eigenvalues. Data hardly determine isometries that preserve the
    observation, checkerboard patterns, and changes far from the observed nodes.

    Args:
        fit: the result of `fit_metric`, or the attribute `MetricFit.problem` of the result.
        values: the unknowns at which to linearise the data, by default the fit's solution.
        n: the number of eigenvectors for the largest eigenvalues.
        n_weak: the number of eigenvectors for the smallest eigenvalues.
        noise: the standard deviation σ of each residual before weighting; 0.01 means 1 % for the loss ``"log"``.
        prior: the prior standard deviation τ of every single unknown, in the units of the parametrisation.
        iterations: the number of subspace iterations. Each iteration multiplies n + 8 vectors by JᵀJ.
        seed: the seed of the random initial subspace.

    Raises:
        ValueError: if `fit` is a problem and `values` is None, or if `n` or `n_weak` is out of range.

    Examples:
        >>> larger = hj.TensorField(field.grid, 1.1 * field.tensors)
        >>> fit = hj.fit_metric(larger, hj.hks(pairs, [0.2, 0.5]), [0.2, 0.5], "conformal")
        >>> found = hj.identifiability(fit, n=4, n_weak=1, iterations=1)
        >>> print(found.effective.round(1))  # of the four strongest directions
        4.0
    """
    problem = fit.problem if isinstance(fit, MetricFit) else fit
    values = fit.values if isinstance(fit, MetricFit) and values is None else values
    if values is None:
        raise ValueError("values: got None, but fit is a problem without a solution; expected the problem's unknowns")
    total = values.size
    if not 1 <= n <= total or not 1 <= n_weak <= total:
        raise ValueError(f"n, n_weak: got {n}, {n_weak}; expected 1 to {total}, the number of unknowns")
    require_number("noise", noise)
    require_number("prior", prior)
    require_count("iterations", iterations)
    keys = jax.random.split(jax.random.key(seed))
    start = jax.random.normal(keys[0], (min(n + 8, total), total), values.dtype)
    strengths, directions = _strongest(problem, values, start, iterations)
    weak_start = jax.random.normal(keys[1], (min(n_weak + 4, total), total), values.dtype)
    weak, weak_directions = _weakest(problem, values, weak_start, strengths[0], 2 * iterations)

    # The weights of the m observed entries add up to one, so weighted residuals have the mean variance σ²/m.
    variance = noise**2 / problem.observation.target.size
    strengths, directions = strengths[:n], directions[:n].reshape(n, *values.shape)
    weak_directions = weak_directions[:n_weak].reshape(n_weak, *values.shape)
    share = strengths / (strengths + variance / prior**2)
    squares = directions.reshape(n, len(values), -1) ** 2
    resolution = jnp.einsum("n,nxc->x", share, squares) / squares.shape[2]
    deviation = prior * jnp.sqrt(jnp.maximum(1 - resolution, 0))
    found = strengths, directions, weak[:n_weak], weak_directions, resolution, deviation
    return Identifiability(*found, jnp.sum(share), noise, prior)


def _information(problem: Problem, values: Values) -> Any:
    """Return a function that multiplies each flat direction of a batch by JᵀJ, where J is the data's Jacobian."""

    def data(flat: Array) -> Array:
        return problem.observation.residuals(problem.pairs(flat.reshape(values.shape)))

    _, product = jax.linearize(data, values.ravel())
    transposed = jax.linear_transpose(product, values.ravel())
    return lambda batch: jax.lax.map(lambda x: transposed(product(x))[0], batch)


@jit_quickly(eqx.filter_jit)
def _strongest(problem: Problem, values: Values, start: Array, iterations: int) -> tuple[Array, Array]:
    product = _information(problem, values)
    block = jax.lax.fori_loop(0, iterations, lambda _, block: _orthonormal(product(block)), _orthonormal(start))
    values, vectors = _ritz(block, product)
    return values[::-1], vectors[::-1]


@jit_quickly(eqx.filter_jit)
def _weakest(problem: Problem, values: Values, start: Array, top: Float[Array, ""], degree: int) -> tuple[Array, Array]:
    product = _information(problem, values)

    def improve(_: Any, state: tuple[Array, Array]) -> tuple[Array, Array]:
        values, block = state
        # The Chebyshev polynomial is small between the mean Ritz value and the largest eigenvalue, and large below.
        cut = jnp.mean(values)
        centre, half = (1.1 * top + cut) / 2, (1.1 * top - cut) / 2

        def scaled(x: Array) -> Array:
            return (product(x) - centre * x) / half

        block, _, _ = chebyshev_recurrence(scaled, block, degree)
        return _ritz(_orthonormal(block), product)

    return jax.lax.fori_loop(0, _ROUNDS, improve, (jnp.full(len(start), 0.2 * top), _orthonormal(start)))


def _orthonormal(block: Float[Array, "n total"]) -> Float[Array, "n total"]:
    return lapack.orthonormal_columns(block.T).T


def _ritz(block: Float[Array, "n total"], product: Callable[[Array], Array]) -> tuple[Array, Array]:
    """Return Ritz values in ascending order and Ritz vectors in the span of orthonormal directions."""
    projected = jnp.matmul(block, product(block).T, precision="highest")
    values, mix = lapack.eigh((projected + projected.T) / 2)
    return values, jnp.matmul(mix.T, block, precision="highest")
