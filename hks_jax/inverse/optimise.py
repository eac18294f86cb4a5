"""The loop of a fit, with compiled steps of an optimistix solver and decisions in Python between steps."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float

from hks_jax.compilation import jit_quickly
from hks_jax.inverse.gauss_newton import GaussNewton
from hks_jax.inverse.problem import Outcome, Problem
from hks_jax.inverse.unknowns import Values

Optimiser = optx.AbstractLeastSquaresSolver | optx.AbstractMinimiser
_REJECTIONS = 12
"""The number of consecutive rejected steps after which a fit counts as stalled."""


def _residuals(values: Values, problem: Problem) -> tuple[Array, Outcome]:
    """Return the residuals, scaled by √n for n nodes so that the loss has curvatures of order 1, and the `Outcome`."""
    data, penalties, outcome = problem.evaluate(values)
    return jnp.sqrt(len(values)) * jnp.concatenate([data, penalties]), outcome


def _half_squares(values: Values, problem: Problem) -> tuple[Float[Array, ""], Outcome]:
    residuals, outcome = _residuals(values, problem)
    return jnp.sum(residuals**2) / 2, outcome


_objective = eqx.filter_custom_jvp(_half_squares)


@_objective.def_jvp
def _objective_jvp(primals: tuple, tangents: tuple) -> tuple:
    """Compute the loss and its gradient, whose norm is reported; all minimisers need the gradient."""
    (values, problem), (direction, _) = primals, tangents
    (value, outcome), gradient = jax.value_and_grad(_half_squares, has_aux=True)(values, problem)
    outcome = outcome._replace(gradient=jnp.linalg.norm(jnp.ravel(gradient)))
    constant = jax.tree.map(lambda x: jnp.zeros_like(x) if eqx.is_inexact_array(x) else None, outcome)
    return (value, outcome), (jnp.sum(gradient * direction), constant)


# A solver's state contains the residual function as a jaxpr, and `_advance` is compiled again for a different jaxpr.
# The cache of `_begin` returns the same jaxpr for all fits with the same shapes.
@jit_quickly(eqx.filter_jit)
def _begin(optimiser: Optimiser, fn: Callable, values: Values, problem: Problem) -> Any:
    struct, aux_struct = eqx.filter_eval_shape(fn, values, problem)
    return _strongly_typed(optimiser.init(fn, values, problem, {}, struct, aux_struct, frozenset()))


@jit_quickly(eqx.filter_jit)
def _advance(
    optimiser: Optimiser, fn: Callable, values: Values, problem: Problem, state: Any, sufficient: Float[Array, ""]
) -> tuple:
    """Take a step. Gauss–Newton computes no further step once the misfit is at most `sufficient`."""

    def enough(outcome: Outcome) -> Bool[Array, ""]:
        return outcome.misfit <= sufficient

    options = {"enough": enough} if isinstance(optimiser, GaussNewton) else {}
    values, state, outcome = optimiser.step(fn, values, problem, options, state, frozenset())
    done, result = optimiser.terminate(fn, values, problem, {}, state, frozenset())
    step_size = jnp.ones(())
    if isinstance(optimiser, GaussNewton):
        outcome = outcome._replace(gradient=jnp.linalg.norm(jnp.ravel(state.gradient)))
        step_size = state.step_size
    return values, _strongly_typed(state), outcome, done, result == optx.RESULTS.successful, step_size


def _strongly_typed(state: Any) -> Any:
    """Return the state without weak types, which would cause a second compilation of the step."""
    return jax.tree.map(lambda x: x.astype(x.dtype) if eqx.is_array(x) else x, state)


class Reached(NamedTuple):
    """The end of a search."""

    values: Values  # the unknowns
    outcome: Outcome | None  # loss and misfit at the unknowns; None if not computed
    result: str  # one of the keys of `metric_fit.RESULTS`

    @property
    def stopped(self) -> bool:
        """Whether the search cannot continue."""
        return self.result in ("interrupted", "not finite")


def optimise(
    problem: Problem, values: Values, optimiser: Optimiser, noise: float | None, max_steps: int, log: Callable
) -> Reached:
    """Take steps until a stopping criterion of the fit is met, and return the unknowns with the smallest loss."""
    fn = _residuals if isinstance(optimiser, optx.AbstractLeastSquaresSolver) else _objective
    best, least, seen = Reached(values, None, ""), np.inf, None
    rejected, number, end = 0, 0, ""
    explained = float(values.dtype.type(-1.0 if noise is None else noise**2 / 2))  # rounded as in `_advance`
    rounding = float(problem.observation.rounding_misfit)
    try:
        state = _begin(optimiser, fn, values, problem)
        # Take one step more than `max_steps`, because many solvers return the result of a step only in the next step.
        for count in range(max_steps + 2):
            before = values
            sufficient = jnp.asarray(jnp.inf if count >= max_steps else explained, values.dtype)
            values, state, outcome, done, fine, size = _advance(optimiser, fn, values, problem, state, sufficient)
            accepted = count == 0 or bool(jnp.any(values != before))
            rejected = 0 if accepted else rejected + 1
            new = seen is None or bool(jnp.any(outcome.values != seen))
            if new or isinstance(optimiser, GaussNewton):
                seen, loss, misfit = outcome.values, float(outcome.loss), float(outcome.misfit)
                gradient = float(outcome.gradient) / len(values)
                if not np.isfinite(loss):
                    return best._replace(result="not finite")
                if loss <= least:
                    best, least = Reached(seen, outcome, ""), loss
                log(number, (loss, misfit, gradient), new, seen, float(size))
                number += 1
                if misfit <= explained:
                    end = "noise level reached"
                elif loss <= rounding:
                    end = "converged"
            if end:
                break
            if not bool(fine):
                end = "not finite"
            elif bool(done):
                end = "converged"
            elif rejected >= _REJECTIONS:
                end = "stalled"
            elif count == max_steps:
                end = "steps exhausted"
            if end == "not finite" or (end and not bool(jnp.any(values != seen))):
                break
    except KeyboardInterrupt:
        end = "interrupted"
    return best._replace(result=end)
