"""Fit a metric to a signature."""

import os
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hks_jax.accuracy import warn_of_accuracy
from hks_jax.checks import require_count, require_number, require_real
from hks_jax.domain.tensor_field import TensorField
from hks_jax.eigen.automatic import choose_for_fit
from hks_jax.eigen.solver import Eigensolver
from hks_jax.fem.assembly import assemble
from hks_jax.fem.boundary import BoundarySpec
from hks_jax.inverse import checkpoint as files
from hks_jax.inverse.checkpoint import Log
from hks_jax.inverse.conformal import InnerProduct
from hks_jax.inverse.metric_fit import MetricFit, Step
from hks_jax.inverse.observation import Function, Loss, Observation, observe, stages_of, weigh
from hks_jax.inverse.optimise import Optimiser
from hks_jax.inverse.parametrisation import Parametrisation, choose_parametrisation
from hks_jax.inverse.problem import Problem, more_pairs, pairs_of_stage, truncation_shows
from hks_jax.inverse.regulariser import Regulariser
from hks_jax.inverse.search import Search, choose_inner_product
from hks_jax.inverse.unknowns import Free, Nodal, Unknowns, nodes_of


def fit_metric(
    target: Any,
    times: Any,
    init: TensorField,
    parametrisation: str | Parametrisation | Callable[[Any], Any] = "log-euclidean",
    *,
    parameters: Any = None,
    signature: str | Function = "hks",
    loss: str | Loss = "log",
    sigma: Any = None,
    weights: Any = None,
    deviation: Any = None,
    regularisers: Sequence[Regulariser] = (),
    noise: float | None = None,
    k: int | None = None,
    boundary: BoundarySpec = "neumann",
    solver: str | Eigensolver = "auto",
    optimiser: str | Optimiser = "gauss-newton",
    smoothness: float | None = None,
    tolerance: float = 1e-4,
    max_steps: int = 50,
    continuation: int = 1,
    starts: int = 1,
    spread: float = 0.1,
    seed: int = 0,
    progress: Callable[[Step], None] | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
) -> MetricFit:
    """Find the metric that has a given signature.

    Minimises half the weighted mean square of the differences between predicted and given signature, in the loss
    chosen, plus the penalties of the regularisers. The signature sees a metric up to isometries that it cannot tell,
    and high frequencies faintly: damped steps, smooth ones by default, take what the data determine first. With
    ``noise`` the fit stops where it explains the misfit (discrepancy principle), which regularises it.

    Args:
        target: (n_times, *grid.shape), positive at observed nodes: ``hks(pairs, times)`` of the metric sought. For
            ``"wks"`` (n_energies, *grid.shape), for ``"heat-trace"`` (n_times,), for ``"eigenvalues"`` (m,) ascending,
            with those that are zero.
        times: (n_times,) for ``"hks"`` and ``"heat-trace"``; energies for ``"wks"``; None for others.
        init: where to start, and what stays where the parametrisation does not reach.
        parametrisation: ``"log-euclidean"`` (the whole tensor), ``"cholesky"``, ``"conformal"`` (e^u T₀),
            ``"eigenvalues"`` (eigenvectors of ``init`` stay), ``"rotation"`` (its eigenvalues stay), a
            `Parametrisation`, or a function of ``parameters`` to a field or to tensors.
        parameters: for a function: where to start, any pytree of arrays.
        signature: ``"hks"``, ``"wks"``, ``"heat-trace"``, ``"eigenvalues"``, or a function of eigenpairs to an array of
            the target's shape.
        loss: ``"log"`` (differences of logarithms), ``"relative"``, ``"absolute"``, or a function of predicted and
            target values, flat, to residuals.
        sigma: the width of a wave kernel signature.
        weights: ≥ 0, broadcast to the target's shape; 0 for what is not observed (it may be NaN there).
        deviation: the standard deviation of the target's noise, of its unit, broadcast to its shape; as
            `hks_jax.uncertainty` gives it. Residuals are weighed by its inverse square, besides by `weights`, and
            ``noise`` is what follows from it unless it is given. Noise that entries share is not heeded.
        regularisers: of `hks_jax.inverse`: `H1`, `TotalVariation`, `LogDeterminant`, `Prior`.
        noise: the standard deviation of the residuals (0.01 for 1 % under ``"log"``): stop where the misfit reaches it.
        k: eigenpairs; by default so many that a share of 1e-6 of the heat trace at the smallest time lies beyond them,
            by Weyl's law; all, if so many are needed. They become more if the fit comes to a field of more volume. For
            ``"wks"`` what lies up to 2σ above the largest energy.
        boundary: as for `eigenpairs`.
        solver: eigensolver; ``"auto"`` chooses for many products with one Jacobian.
        optimiser: ``"gauss-newton"`` (damped, matrix-free), ``"lbfgs"``, ``"bfgs"``, or a solver of optimistix.
        smoothness: the length, in coordinate units, below which Gauss–Newton steps are smooth; 0 for no preference; by
            default a tenth of the domain, and 0 for ``"conformal"`` without noise.
        tolerance: what the unknowns u still change, relative to 1 + |u| (root mean square over all of them), when it
            has converged: both the last step and what is left by it and the one before, were they the beginning of a
            geometric series, are below it. As soon as the next step is likely to be, the linear systems are solved 30
            times more exactly, with three times as many products: only a step of that kind may be the last. Directions
            that so many products do not find are not in it: `identifiability` tells of them. (Solvers of optimistix:
            the last step alone.)
        max_steps: steps per stage.
        continuation: stages: the first fits the largest times alone, the last all of them.
        starts: how often to start, the first time from ``init``, then from random smooth changes of it; the best wins.
        spread: their root mean square, in the parameters' units.
        seed: their seed.
        progress: called with each step; ``print`` will do.
        checkpoint: a file to write after each step. If it is there already, the fit goes on from it.

    Returns:
        The fit. ``fit.result`` says how it ended; nothing is raised when it stalls or is interrupted.

    Warns:
        AccuracyWarning: the misfit is near to what k pairs leave out: the fit matches its own truncation; or it stays
            above what ``noise`` explains: no metric that the parametrisation has explains the target.

    Raises:
        ValueError: a target that is NaN, not positive or of the wrong shape; times that the grid cannot resolve; an
            unknown choice; a checkpoint of another fit.
    """
    clock = time.perf_counter()
    if not isinstance(init, TensorField):
        raise TypeError(f"init: got {type(init).__name__}; expected hks_jax.TensorField")
    for name, number in (("max_steps", max_steps), ("continuation", continuation), ("starts", starts)):
        require_count(name, number)
    require_number("tolerance", tolerance, 1)
    require_number("spread", spread, inclusive=True)
    if noise is not None:
        require_number("noise", noise)
    if smoothness is not None:
        require_number("smoothness", smoothness, inclusive=True)
    if deviation is not None:
        weights, stated = weigh(target, weights, deviation, loss)
        noise = stated if noise is None else noise
    pencil = assemble(init, boundary)
    space, dtype, shape = pencil.space, init.domain_tensors.dtype, np.shape(target)
    unknowns = _unknowns(parametrisation, parameters, init, space.domain)

    def observation(weights: Any) -> Observation:
        return observe(target, times, weights, signature, loss, sigma, space, dtype)

    def problem_of(observed: Observation, pairs: int) -> Problem:
        chosen = choose_for_fit(pencil, pairs) if solver == "auto" else solver
        return Problem(unknowns, observed, tuple(regularisers), pairs, boundary, chosen)

    whole = observation(weights)
    stages = stages_of(whole, weights, shape, continuation, observation)
    problems = [problem_of(each, pairs_of_stage(each, k, shape, pencil, init)) for each in stages]
    inner_product, first = choose_inner_product(unknowns, smoothness, noise), unknowns.start()

    choices = parametrisation, k, boundary, optimiser, smoothness, tolerance, continuation, starts, spread, seed, noise
    mark = files.fingerprint(whole, weights, init.domain_tensors, regularisers, repr(choices))
    now = files.Checkpoint(first, [], 0, 0, 1.0, first, [])
    if checkpoint is not None and Path(checkpoint).exists():
        now = files.load(checkpoint, mark)
        clock -= now.history[-1].seconds
    log = Log(now, progress, checkpoint, mark, clock)
    search = Search(optimiser, tolerance, noise, inner_product, max_steps, log)
    reached = search.from_starts(problems, lambda start: _moved(first, inner_product, spread, seed, start), starts)
    now.stage, now.best = len(problems), reached.values
    renewed = partial(problem_of, whole) if k is None else None
    values, outcome, result, problem = search.with_enough_pairs(reached, problems[-1], renewed)
    for message in outcome.pairs.messages():
        warn_of_accuracy(message)
    misfit, left = float(outcome.misfit), float(outcome.truncation)
    if truncation_shows(misfit, left):
        warn_of_accuracy(
            f"k: {problem.k} eigenpairs leave out what amounts to a misfit of about {left:.1e}, and the fit's is "
            f"{misfit:.1e}: it has fitted its own truncation. Use k=None, or k={more_pairs(problem, values)} or "
            f"more; only if the target was itself computed with {problem.k} pairs is nothing wrong"
        )
    elif noise is not None and result in ("converged", "stalled") and misfit > noise**2:
        warn_of_accuracy(
            f"noise: the fit {result} at residuals of {(2 * misfit) ** 0.5:.2g}, of which noise explains {noise:.2g}: "
            "no metric of this parametrisation that it found explains the target. Use another parametrisation, such as "
            '"log-euclidean", another init or weaker regularisers; or the noise is larger. What the fit added '
            "to init may be the misfit's and not the metric's"
        )
    history, losses = tuple(now.history), tuple(now.losses)
    field, reached_loss = unknowns.field(values), float(outcome.loss)
    return MetricFit(field, reached_loss, misfit, left, history, result, values, problem, losses, noise)


def _unknowns(parametrisation: Any, parameters: Any, init: TensorField, domain: np.ndarray) -> Unknowns:
    """Return what varies."""
    if callable(parametrisation) and not isinstance(parametrisation, Parametrisation):
        if parameters is None:
            raise ValueError("parameters: got None; a parametrisation by a function needs parameters to start from")
        require_real("parameters", parameters)
        return Free(parametrisation, parameters, init)
    return Nodal(choose_parametrisation(parametrisation), init, nodes_of(domain))


def _moved(first: Any, inner_product: InnerProduct, spread: float, seed: int, start: int) -> Any:
    """Return the values to begin a further start with, the first ones with smooth noise."""
    noise = jax.random.normal(jax.random.fold_in(jax.random.key(seed), start), first.shape, first.dtype)
    noise = inner_product.solve(noise)
    return first + spread * noise / jnp.sqrt(jnp.mean(noise**2))
