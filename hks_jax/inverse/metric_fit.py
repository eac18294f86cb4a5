"""The result of a fit, and its error bars: draws from the posterior that its linearisation has."""

import dataclasses
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from hks_jax.checks import require_count, require_number
from hks_jax.compilation import jit_quickly
from hks_jax.domain.tensor_field import TensorField
from hks_jax.inverse.problem import Problem
from hks_jax.inverse.unknowns import Values

_TOLERANCE, _STEPS = 1e-6, 1000
"""Of the residuals of conjugate gradients, relative, and their number at most."""

RESULTS = {
    "converged": "the unknowns no longer change by more than the tolerance",
    "noise level reached": "the misfit is as small as the stated noise",
    "steps exhausted": "max_steps was reached; allow more",
    "stalled": "no step improves the loss any more; damping, regularisers or k may need a change",
    "not finite": "the signature or its derivative is NaN or infinite; see the warnings",
    "interrupted": "stopped from outside",
}


@dataclasses.dataclass(frozen=True)
class Step:
    """One step of a fit.

    Attributes:
        step: its number, from 0 for the unknowns before any change. Of solvers of optimistix only steps that were taken
            are told, not those that were tried.
        loss: half the weighted mean square of the residuals, plus the penalties.
        misfit: the part of the data.
        gradient: the norm of the loss's gradient; NaN where nobody computed it (least squares solvers of optimistix).
        accepted: whether the step was taken.
        seconds: since the start.
        stage: which part of the continuation.
        start: which of the starts.
    """

    step: int
    loss: float
    misfit: float
    gradient: float
    accepted: bool
    seconds: float
    stage: int = 0
    start: int = 0

    def __str__(self) -> str:
        where = (f"start {self.start}, " if self.start else "") + (f"stage {self.stage}, " if self.stage else "")
        mark = "" if self.accepted else ", rejected"
        return (
            f"{where}step {self.step}: loss {self.loss:.3e}, gradient {self.gradient:.1e}, {self.seconds:.1f} s{mark}"
        )


class Posterior(eqx.Module):
    """The uncertainty of a fitted metric that noise and prior leave, to first order.

    Attributes:
        values: (*values) the standard deviations of the unknowns, in the parametrisation's units.
        tensors: (*shape, d, d) the standard deviations of the tensors' components.
        unsolved: the largest relative residual of the linear systems of the draws.
        sampling_error: the relative standard deviation of all of these deviations.
    """

    values: Float[Array, "*values"]
    tensors: Float[Array, "*shape d d"]
    unsolved: Float[Array, ""]
    sampling_error: float = eqx.field(static=True)


@dataclasses.dataclass(frozen=True)
class MetricFit:
    """The result of `fit_metric`.

    Attributes:
        field: the fitted metric.
        loss: half the weighted mean square of the residuals, plus the penalties.
        misfit: the part of the data.
        truncation_misfit: an estimate of the misfit that the metric itself would have to a target of all eigenpairs, as
            k are computed; 0 for signatures that k pairs define.
        history: one entry for each step.
        result: one of the keys of `RESULTS`, whose values explain them.
        values: the unknowns, as the parametrisation has them.
        problem: the least squares problem, for `identifiability` and for a fit of your own.
        losses: the loss of each start.
        noise: the standard deviation of the residuals that was stated, or that of the target made; else None.
    """

    field: TensorField
    loss: float
    misfit: float
    truncation_misfit: float
    history: tuple[Step, ...]
    result: str
    values: Values
    problem: Problem
    losses: tuple[float, ...]
    noise: float | None = None

    @property
    def converged(self) -> bool:
        """Whether it stopped by itself at a solution."""
        return self.result in ("converged", "noise level reached")

    @property
    def steps(self) -> int:
        """How many steps were computed, over all stages and starts."""
        # Step 0 of a stage, or of a fit resumed, changes nothing.
        return sum(step.step > 0 for step in self.history)

    @property
    def hks(self) -> Array:
        """The signature of the fitted metric, of the kind and shape of the target; computed anew each time."""
        return self.problem.observation.predict(self.problem.pairs(self.values))

    def uncertainty(self, prior: float = 1.0, noise: float | None = None, draws: int = 32, seed: int = 0) -> Posterior:
        """Compute the error bars of the fitted metric, to first order about it: Laplace's approximation.

        The posterior of the unknowns has the covariance (JᵀΣ⁻¹J + R)⁻¹: J is the Jacobian of the data, Σ their noise,
        weighed as in the fit, and R the Hessian of the penalties and of a white prior. Draws from it come of one linear
        system each, by conjugate gradients.

        Args:
            prior: the standard deviation that every unknown has without data, in the parametrisation's units.
            noise: of the residuals; None: that of the fit.
            draws: how many; a deviation is sure to 1/√(2·draws) of itself.
            seed: of the draws.

        Raises:
            ValueError: a fit without noise, when none is given.
        """
        noise = self.noise if noise is None else noise
        if noise is None:
            raise ValueError("noise: the fit has none; give the standard deviation of its residuals, or fit with one")
        require_number("noise", noise)
        require_number("prior", prior)
        require_count("draws", draws)
        # The weights add up to one over m entries: a residual of deviation σ has σ²/m after weighting, in the mean.
        scale = math.sqrt(self.problem.observation.target.size) / noise
        dtype, keys = self.values.dtype, jax.random.split(jax.random.key(seed), draws)
        numbers = jnp.asarray(scale, dtype), jnp.asarray(prior, dtype)
        return Posterior(*_deviations(self.problem, self.values, *numbers, keys), 1 / math.sqrt(2 * draws))

    def __repr__(self) -> str:
        return f"MetricFit({self.result}: loss {self.loss:.3e} after {self.steps} steps)"


# With independent standard normal numbers ξ the right-hand side Aᵀξ + ξ₀/τ has the covariance H = AᵀA + 1/τ², so that
# H⁻¹ times it has H⁻¹ (Papandreou and Yuille 2010).
@jit_quickly(eqx.filter_jit)
def _deviations(
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
