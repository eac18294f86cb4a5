"""The result of a fit, and its error bars by draws from the linearised posterior."""

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
"""The relative residual of conjugate gradients, and the maximum number of their steps."""

RESULTS = {
    "converged": "the unknowns no longer change by more than the tolerance, or the residuals are rounding errors",
    "noise level reached": "the misfit is as small as the stated noise",
    "steps exhausted": "the number of steps reached max_steps; increase it",
    "stalled": "no step reduces the loss; change the damping, the regularisers or k",
    "not finite": "the signature or its derivative is NaN or infinite; check the warnings",
    "interrupted": "the fit was interrupted",
}


@dataclasses.dataclass(frozen=True)
class Step:
    """The record of one step of a fit.

    Attributes:
        step: the number of the step; step 0 evaluates the initial unknowns. Optimistix reports only accepted steps.
        loss: half the weighted mean square of the residuals, plus the penalties.
        misfit: the data's part of the loss.
        gradient: the norm of the loss's gradient; NaN for least squares solvers of optimistix, which do not compute it.
        accepted: whether the step was accepted.
        seconds: the time since the fit began.
        stage: the index of the continuation stage; later stages fit smaller times.
        start: the index of the initial guess; 0 is the initial field, others are random changes of this field.
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
    """The first-order uncertainty of a fitted metric, given noise and prior.

    Attributes:
        values: (*values) the standard deviations of the unknowns, in the parametrisation's units.
        tensors: (*shape, d, d) the standard deviations of the tensors' components.
        unsolved: the largest relative residual of the linear systems that were solved for the draws.
        sampling_error: the relative standard error of the standard deviations, due to the number of draws.
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
        misfit: the data's part of the loss.
        truncation_misfit: an estimate of the misfit between the metric's signatures from k and from all eigenpairs; 0
            for signatures that the k pairs define.
        history: one entry for each step.
        result: how the fit ended, for example ``"converged"``, ``"steps exhausted"`` or ``"stalled"``.
        values: the unknowns of the parametrisation.
        problem: the least squares problem, for `identifiability` and for custom fits.
        losses: the final loss for each initial guess.
        noise: the standard deviation of the residuals, from `Data.noise` or `Data.deviation`; None if both are None.
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
        """Whether the fit converged to a solution or to the noise level."""
        return self.result in ("converged", "noise level reached")

    @property
    def steps(self) -> int:
        """The number of computed steps in all stages and from all initial guesses."""
        # Step 0 of a stage or of a resumed fit only evaluates the loss, so it does not count.
        return sum(step.step > 0 for step in self.history)

    @property
    def hks(self) -> Array:
        """The signature of the fitted metric, of the kind and shape of the target; each access computes it again."""
        return self.problem.observation.predict(self.problem.pairs(self.values))

    def uncertainty(self, prior: float = 1.0, noise: float | None = None, draws: int = 32, seed: int = 0) -> Posterior:
        """Compute first-order error bars of the fitted metric by Laplace's approximation.

        The covariance of the posterior is (JᵀΣ⁻¹J + R)⁻¹, where J is the Jacobian of the data and R is the Hessian of
        the penalties and a white prior. The noise covariance Σ is diagonal, and its variances are inversely
        proportional to the fit's weights. Each draw solves one linear system by conjugate gradients.

        Args:
            prior: the prior standard deviation of every unknown, in the parametrisation's units.
            noise: the standard deviation of the residuals, by default `MetricFit.noise`.
            draws: the number of draws; the relative error of a standard deviation is 1/√(2·draws).
            seed: the seed of the draws.

        Raises:
            ValueError: if neither the fit nor the argument `noise` gives the standard deviation of the residuals.
        """
        noise = self.noise if noise is None else noise
        if noise is None:
            raise ValueError("noise: got None for a fit without noise; expected the residuals' standard deviation")
        require_number("noise", noise)
        require_number("prior", prior)
        require_count("draws", draws)
        # The weights of the m observed entries add up to one, so weighted residuals have the mean variance σ²/m.
        scale = math.sqrt(self.problem.observation.target.size) / noise
        dtype, keys = self.values.dtype, jax.random.split(jax.random.key(seed), draws)
        numbers = jnp.asarray(scale, dtype), jnp.asarray(prior, dtype)
        return Posterior(*_deviations(self.problem, self.values, *numbers, keys), 1 / math.sqrt(2 * draws))

    def __repr__(self) -> str:
        return f"MetricFit({self.result}: loss {self.loss:.3e} after {self.steps} steps)"


# Let A be the Jacobian of the residuals and τ the prior's standard deviation. For independent standard normal vectors ξ
# and ξ₀, the vector b = Aᵀξ + ξ₀/τ has the covariance H = AᵀA + 1/τ². So the solution x of the linear system Hx = b has
# the covariance H⁻¹ (Papandreou and Yuille 2010).
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
