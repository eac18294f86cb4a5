"""Fit a metric to a signature."""

import dataclasses
import math
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hks_jax.accuracy import warn_of_accuracy
from hks_jax.checks import require_count, require_number, require_real
from hks_jax.domain.tensor_field import TensorField
from hks_jax.eigen.choice import choose_for_fit
from hks_jax.eigen.solver import Eigensolver
from hks_jax.fem.assembly import assemble
from hks_jax.fem.boundary import BoundarySpec
from hks_jax.fem.pencil import MirrorPencil, Pencil
from hks_jax.inverse import checkpoint as files
from hks_jax.inverse.method import choose_inner_product, choose_optimiser
from hks_jax.inverse.metric_fit import MetricFit, Step
from hks_jax.inverse.observation import Loss, Observation, Signature, observe
from hks_jax.inverse.optimise import Optimiser, optimise
from hks_jax.inverse.parametrisation import Parametrisation, choose_parametrisation
from hks_jax.inverse.problem import Problem, most_pairs, pairs_below, pairs_for, unknowns_of
from hks_jax.inverse.regulariser import Regulariser
from hks_jax.inverse.smoothing import InnerProduct
from hks_jax.inverse.truncated import Outcome, more_pairs, observed_times, outcome_of, truncation_shows
from hks_jax.inverse.unknowns import Free, Nodal, Unknowns, nodes_of


def fit_metric(
    target: Any,
    times: Any,
    init: TensorField,
    parametrisation: str | Parametrisation | Callable[[Any], Any] = "log-euclidean",
    *,
    parameters: Any = None,
    signature: str | Signature = "hks",
    loss: str | Loss = "log",
    sigma: Any = None,
    weights: Any = None,
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
        AccuracyWarning: the misfit is near to what k pairs leave out: the fit matches its own truncation.

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
    pencil = assemble(init, boundary)
    space, dtype = pencil.space, init.domain_tensors.dtype
    unknowns: Unknowns
    if callable(parametrisation) and not isinstance(parametrisation, Parametrisation):
        if parameters is None:
            raise ValueError("parameters: got None; a parametrisation by a function needs parameters to start from")
        require_real("parameters", parameters)
        unknowns = Free(parametrisation, parameters, init)
    else:
        unknowns = Nodal(choose_parametrisation(parametrisation), init, nodes_of(space.domain))

    def observation(weights: Any) -> Observation:
        return observe(target, times, weights, signature, loss, sigma, space, dtype)

    whole = observation(weights)
    stages = _stages(whole, weights, np.shape(target), continuation, observation)
    problems = []
    for each in stages:
        pairs = _pairs(each, k, np.shape(target), pencil, init)
        chosen = choose_for_fit(pencil, pairs) if solver == "auto" else solver
        problems.append(Problem(unknowns, each, tuple(regularisers), pairs, boundary, chosen))

    inner_product = choose_inner_product(unknowns, smoothness, noise)
    first = unknowns.start()
    settings = (
        parametrisation,
        k,
        boundary,
        optimiser,
        smoothness,
        tolerance,
        continuation,
        starts,
        spread,
        seed,
        noise,
    )
    mark = files.fingerprint(whole, weights, init.domain_tensors, regularisers, repr(settings))
    resumed = files.load(checkpoint, mark) if checkpoint is not None and Path(checkpoint).exists() else None

    log = _Log(progress, checkpoint, mark, first)
    if resumed:
        log.history, log.losses, log.best = list(resumed.history), list(resumed.losses), jnp.asarray(resumed.best)
        clock -= log.history[-1].seconds
    result = best_result = "interrupted"
    outcome: Outcome | None = None  # of the best unknowns, as far as it is known
    # The last stage may be followed by one with more eigenpairs, in which no start is open any more.
    extended = resumed is not None and resumed.stage == len(problems)
    first_start = resumed.start if resumed else 0
    for log.start in range(starts if extended else first_start, starts):
        values, step_size, from_stage = _moved(first, inner_product, spread, seed, log.start), 1.0, 0
        reached: Outcome | None = None
        if resumed and log.start == resumed.start:
            values, step_size, from_stage = jnp.asarray(resumed.values), resumed.step_size, resumed.stage
        for log.stage in range(from_stage, len(problems)):
            # Early stages need no last digits.
            enough = tolerance if log.stage == len(problems) - 1 else 100 * tolerance
            method = choose_optimiser(optimiser, problems[log.stage], enough, noise, inner_product, step_size)
            values, reached, result = optimise(
                problems[log.stage], values, method, noise, max_steps, log, log.stage, log.start, clock
            )
            step_size = 1.0
            if result in ("interrupted", "not finite"):
                break
        if reached is None or log.stage < len(problems) - 1:
            reached = outcome_of(problems[-1], values)
        loss_reached = float(reached.loss)
        if not log.losses or not loss_reached >= min(log.losses):
            log.best, best_result, outcome = values, result, reached
        log.losses.append(loss_reached)
        if result == "interrupted":
            break
    problem = problems[-1]
    if extended and resumed is not None:
        log.best, best_result = jnp.asarray(resumed.values), "converged"
    log.stage = len(problems)
    # k was chosen for the volume of the start: the fit may have come to more of it.
    while True:
        *numbers, final_pairs = outcome or outcome_of(problem, log.best)
        final, misfit, left = map(float, numbers)
        shows = truncation_shows(misfit, left)
        wanted = more_pairs(problem, log.best) if shows and k is None else problem.k
        if wanted <= problem.k or best_result in ("interrupted", "not finite"):
            break
        chosen = choose_for_fit(pencil, wanted) if solver == "auto" else solver
        problem = Problem(unknowns, whole, tuple(regularisers), wanted, boundary, chosen)
        method = choose_optimiser(optimiser, problem, tolerance, noise, inner_product)
        log.best, outcome, best_result = optimise(
            problem, log.best, method, noise, max_steps, log, log.stage, log.start, clock
        )
    for message in final_pairs.messages():
        warn_of_accuracy(message)
    if shows:
        warn_of_accuracy(
            f"k: {problem.k} eigenpairs leave out what amounts to a misfit of about {left:.1e}, and the fit's is "
            f"{misfit:.1e}: it has fitted its own truncation. Use k=None, or k={more_pairs(problem, log.best)} or "
            f"more; only if the target was itself computed with {problem.k} pairs is nothing wrong"
        )
    history, losses = tuple(log.history), tuple(log.losses)
    return MetricFit(unknowns.field(log.best), final, misfit, left, history, best_result, log.best, problem, losses)


@dataclasses.dataclass
class _Log:
    """What happened so far; called after each step, it tells and saves it."""

    progress: Callable[[Step], None] | None
    path: str | os.PathLike[str] | None
    mark: str
    best: Any
    history: list[Step] = dataclasses.field(default_factory=list)
    losses: list[float] = dataclasses.field(default_factory=list)
    start: int = 0
    stage: int = 0

    def __call__(self, step: Step, values: Any, step_size: float) -> None:
        self.history.append(step)
        if self.progress is not None:
            self.progress(step)
        if self.path is not None:
            now = files.Checkpoint(values, self.history, self.start, self.stage, step_size, self.best, self.losses)
            files.save(self.path, self.mark, now)


def _stages(
    whole: Observation, weights: Any, shape: tuple[int, ...], count: int, build: Callable[[Any], Observation]
) -> list[Observation]:
    """Return the observation of each stage: the largest times first."""
    if count == 1 or whole.signature not in ("hks", "heat-trace"):
        return [whole]
    assert whole.times is not None
    order = np.argsort(-np.asarray(whole.times))
    base = np.broadcast_to(np.ones(()) if weights is None else np.asarray(weights, float), shape)
    stages = []
    for stage in range(1, count):
        used = np.zeros(shape[0], dtype=bool)
        used[order[: math.ceil(shape[0] * stage / count)]] = True
        stages.append(build(base * used.reshape(-1, *[1] * (len(shape) - 1))))
    return [*stages, whole]


def _pairs(
    observation: Observation,
    k: int | None,
    shape: tuple[int, ...],
    pencil: Pencil | MirrorPencil,
    field: TensorField,
) -> int:
    """Return how many eigenpairs to compute."""
    if observation.signature == "eigenvalues":
        return shape[0]
    if callable(observation.signature):
        if k is None:
            raise ValueError("k: got None; a signature of your own needs the number of eigenpairs")
        return k
    assert observation.times is not None
    if observation.signature == "wks":
        assert observation.sigma is not None
        reach = float(jnp.max(observation.times) + 2 * observation.sigma)
        wanted, unknowns = pairs_below(math.exp(reach), pencil, field), unknowns_of(pencil)
        if k is None and wanted > most_pairs(unknowns):
            raise ValueError(
                f"times: got energies up to {float(jnp.max(observation.times)):.4g}, which take about {wanted} "
                f"eigenpairs; with {unknowns} unknowns {most_pairs(unknowns)} can be fitted. Use lower energies"
            )
    else:
        wanted = pairs_for(observed_times(observation), pencil, field)  # those of this stage
    return wanted if k is None else k


def _moved(first: Any, inner_product: InnerProduct, spread: float, seed: int, start: int) -> Any:
    """Return the values to begin with: the first as they are, the others with smooth noise."""
    if start == 0:
        return first
    noise = jax.random.normal(jax.random.fold_in(jax.random.key(seed), start), first.shape, first.dtype)
    noise = inner_product.solve(noise)
    return first + spread * noise / jnp.sqrt(jnp.mean(noise**2))
