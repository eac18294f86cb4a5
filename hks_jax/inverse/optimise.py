"""The loop: steps of an optimistix solver, each compiled, with what lies between them in Python."""

import time
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from hks_jax.inverse.metric_fit import Step
from hks_jax.inverse.problem import Problem
from hks_jax.inverse.unknowns import Values

Optimiser = optx.AbstractLeastSquaresSolver | optx.AbstractMinimiser
_REJECTIONS = 12
"""Rejected steps in a row after which a fit counts as stalled."""


def _residuals(values: Values, problem: Problem) -> tuple[Array, tuple[Array, Array]]:
    """Return residuals, with the loss and the misfit of the data.

    They are scaled by the number of nodes, so that a step's curvature is of order one whatever the grid.
    """
    data, penalties = problem.residuals(values)
    misfit = jnp.sum(data**2) / 2
    everything = jnp.sqrt(len(values)) * jnp.concatenate([data, penalties])
    return everything, (misfit + jnp.sum(penalties**2) / 2, misfit)


def _objective(values: Values, problem: Problem) -> tuple[Float[Array, ""], tuple[Array, Array]]:
    residuals, aux = _residuals(values, problem)
    return jnp.sum(residuals**2) / 2, aux


# A solver's state holds the residuals' trace, and the same one, out of this function's cache, for every fit of the same
# shapes: `_advance` tells traces apart.
@eqx.filter_jit
def _begin(optimiser: Optimiser, fn: Callable, values: Values, problem: Problem) -> Any:
    """Return the solver's state before the first step."""
    struct, aux_struct = eqx.filter_eval_shape(fn, values, problem)
    return optimiser.init(fn, values, problem, {}, struct, aux_struct, frozenset())


@eqx.filter_jit
def _advance(optimiser: Optimiser, fn: Callable, values: Values, problem: Problem, state: Any) -> tuple:
    values, state, aux = optimiser.step(fn, values, problem, {}, state, frozenset())
    done, result = optimiser.terminate(fn, values, problem, {}, state, frozenset())
    # What the step before knew, where the solver does not keep what belongs to the unknowns.
    aux = getattr(state, "aux", aux)
    return values, state, aux, done, result == optx.RESULTS.successful, _gradient(state)


def _gradient(state: Any) -> Float[Array, ""]:
    """Return the norm of the gradient, where the solver's state has it."""
    gradient = getattr(getattr(state, "descent_state", None), "gradient", None)
    if gradient is None:
        gradient = getattr(getattr(state, "f_info", None), "grad", None)
    return jnp.asarray(jnp.nan) if gradient is None else jnp.linalg.norm(jnp.ravel(gradient))


@eqx.filter_jit
def loss_of(problem: Problem, values: Values) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return the loss and the misfit."""
    return _objective(values, problem)[1]


def optimise(
    problem: Problem,
    values: Values,
    optimiser: Optimiser,
    noise: float | None,
    max_steps: int,
    report: Callable[[Step, Values, float], None],
    stage: int,
    start: int,
    clock: float,
) -> tuple[Values, str]:
    """Run until the solver, the noise level or the number of steps says stop.

    Args:
        problem: the residuals.
        values: where to begin.
        optimiser: the solver.
        noise: standard deviation of the residuals that noise explains; None runs to convergence.
        max_steps: steps after which to give up.
        report: called after each step with its record, the unknowns, and the solver's step size.
        stage: for the record.
        start: for the record.
        clock: when the fit began.

    Returns:
        The best unknowns seen, and one of the keys of `metric_fit.RESULTS`.
    """
    fn = _residuals if isinstance(optimiser, optx.AbstractLeastSquaresSolver) else _objective
    best, least = values, np.inf
    rejected = 0
    try:
        state = _begin(optimiser, fn, values, problem)
        for step in range(max_steps + 1):
            before = values
            values, state, (loss, misfit), done, fine, gradient = _advance(optimiser, fn, values, problem, state)
            accepted = step == 0 or bool(jnp.any(values != before))
            rejected = 0 if accepted else rejected + 1
            gradient = float(gradient) / np.sqrt(len(values))
            record = Step(
                step, float(loss), float(misfit), gradient, accepted, time.perf_counter() - clock, stage, start
            )
            if not np.isfinite(record.loss):
                return best, "not finite"
            if record.loss <= least:
                best, least = values, record.loss
            size = getattr(getattr(state, "search_state", None), "step_size", 1.0)
            report(record, values, float(size))
            if noise is not None and record.misfit <= noise**2 / 2:
                return best, "noise level reached"
            if not bool(fine):
                return best, "not finite"
            if bool(done):
                return best, "converged"
            if rejected >= _REJECTIONS:
                return best, "stalled"
    except KeyboardInterrupt:
        return best, "interrupted"
    return best, "steps exhausted"
