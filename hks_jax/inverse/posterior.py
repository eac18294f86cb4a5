"""Error bars of a fitted metric: draws from the posterior that its linearisation has."""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from hks_jax.checks import require_count, require_number
from hks_jax.compilation import jit_quickly
from hks_jax.inverse.problem import Problem
from hks_jax.inverse.unknowns import Values

_TOLERANCE, _STEPS = 1e-6, 1000
"""Of the residuals of conjugate gradients, relative, and their number at most."""


class Posterior(eqx.Module):
    """What noise and prior leave open of a fitted metric, to first order.

    Attributes:
        values: (*values) the standard deviations of the unknowns, in the parametrisation's units.
        tensors: (*shape, d, d) those of the tensors' components.
        unsolved: the largest relative residual of the linear systems of the draws.
        sampling_error: the relative standard deviation of all of these deviations.
    """

    values: Float[Array, "*values"]
    tensors: Float[Array, "*shape d d"]
    unsolved: Float[Array, ""]
    sampling_error: float = eqx.field(static=True)


def posterior(problem: Problem, values: Values, noise: float, prior: float, draws: int, seed: int) -> Posterior:
    """Return the deviations of unknowns and tensors; see `MetricFit.uncertainty`."""
    require_number("noise", noise)
    require_number("prior", prior)
    require_count("draws", draws)
    # The weights add up to one over m entries: a residual of deviation σ has σ²/m after weighting, in the mean.
    scale = math.sqrt(problem.observation.target.size) / noise
    keys = jax.random.split(jax.random.key(seed), draws)
    squares = _squares(problem, values, jnp.asarray(scale, values.dtype), jnp.asarray(prior, values.dtype), keys)
    return Posterior(*squares, 1 / math.sqrt(2 * draws))


# With independent standard normal numbers ξ the right-hand side Aᵀξ + ξ₀/τ has the covariance H = AᵀA + 1/τ², so that
# H⁻¹ times it has H⁻¹ (Papandreou and Yuille 2010).
@jit_quickly(eqx.filter_jit)
def _squares(
    problem: Problem, values: Values, scale: Float[Array, ""], prior: Float[Array, ""], keys: Array
) -> tuple[Array, Array, Array]:
    def residuals(values: Values) -> Array:
        return scale * ravel_pytree(problem.residuals(values))[0]

    at, product = jax.linearize(residuals, values)
    transposed = jax.linear_transpose(product, values)
    _, to_tensors = jax.linearize(lambda values: problem.unknowns.field(values).tensors, values)

    def information(x: Values) -> Values:
        return transposed(product(x))[0] + x / prior**2

    def draw(key: Array) -> tuple[Any, Any, Any]:
        of_data, of_prior = jax.random.split(key)
        noise = jax.random.normal(of_data, at.shape, at.dtype)
        rhs = transposed(noise)[0] + jax.random.normal(of_prior, values.shape, values.dtype) / prior
        x, _ = jax.scipy.sparse.linalg.cg(information, rhs, tol=_TOLERANCE, maxiter=_STEPS)
        left = jnp.linalg.norm((information(x) - rhs).ravel()) / jnp.linalg.norm(rhs.ravel())
        return x**2, to_tensors(x) ** 2, left

    squares, of_tensors, left = jax.lax.map(draw, keys)
    return jnp.sqrt(jnp.mean(squares, axis=0)), jnp.sqrt(jnp.mean(of_tensors, axis=0)), jnp.max(left)
