"""Fit a metric to a signature."""

import os
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from hks_jax.accuracy import warn_of_accuracy
from hks_jax.domain.grid import Grid
from hks_jax.domain.tensor_field import TensorField
from hks_jax.eigen.automatic import choose_for_fit
from hks_jax.eigen.solver import Eigensolver
from hks_jax.fem.assembly import assemble
from hks_jax.fem.boundary import BoundarySpec
from hks_jax.inverse import checkpoint as files
from hks_jax.inverse.metric_fit import MetricFit, Step
from hks_jax.inverse.observation import Data, Observation, observe
from hks_jax.inverse.problem import Problem, more_pairs, truncation_shows
from hks_jax.inverse.regulariser import Regulariser
from hks_jax.inverse.search import Run, Search, choose_inner_product
from hks_jax.inverse.unknowns import Free, Nodal, Parametrisation, flat_field, unknowns_for


def fit_metric(
    init: Grid | TensorField,
    target: Any,
    times: Any = None,
    parametrisation: str | Parametrisation | Free = "log-euclidean",
    *,
    data: Data = Data(),  # noqa: B008
    regularisers: Sequence[Regulariser] = (),
    k: int | None = None,
    boundary: BoundarySpec = "neumann",
    solver: str | Eigensolver = "auto",
    search: Search = Search(),  # noqa: B008
    progress: Callable[[Step], None] | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
) -> MetricFit:
    """Find the metric that has a given signature.

    Minimises half the weighted mean square of the differences between predicted and given signature, plus the penalties
    of the regularisers. The signature does not tell isometric metrics apart, and sees high frequencies faintly: damped
    steps, smooth ones by default, change first the directions that the data determine.

    Args:
        init: where to start: a grid, for the flat metric, or a field. Properties of the field that the parametrisation
            does not change stay.
        target: (n_times, *grid.shape), positive at observed nodes: ``hks(pairs, times)`` of the metric sought. A wave
            kernel signature is (n_energies, *grid.shape), a heat trace (n_times,); eigenvalues are (m,), ascending,
            with those that are zero.
        times: (n_times,); energies of a wave kernel signature; None where the signature has neither.
        parametrisation: ``"log-euclidean"`` (the whole tensor), ``"cholesky"``, ``"conformal"`` (e^u T₀),
            ``"eigenvalues"`` (eigenvectors of `init` stay), ``"rotation"`` (its eigenvalues stay), a `Parametrisation`,
            or `Free` parameters of a function.
        data: which signature the target is, how differences count, which entries are observed, and their noise.
        regularisers: of `hks_jax.inverse`: `H1`, `TotalVariation`, `LogDeterminant`, `Prior`.
        k: eigenpairs. By default Weyl's law gives a number that leaves a share of 1e-6 of the heat trace at the
            smallest time beyond them, at most all; it grows if the fit comes to a field of more volume. For a wave
            kernel signature, those up to 2σ above the largest energy.
        boundary: as for `eigenpairs`.
        solver: eigensolver; ``"auto"`` chooses for many products with one Jacobian.
        search: how to look for the metric, and when to stop.
        progress: called with each step; ``print`` will do.
        checkpoint: a file to write after each step. If it is there already, the fit goes on from it.

    Returns:
        The fit. ``fit.result`` says how it ended; nothing is raised when it stalls or is interrupted.

    Warns:
        AccuracyWarning: the misfit is near the truncation error of k pairs: the fit matches its own truncation. Or it
            stays above the noise: no metric of this parametrisation explains the target.

    Raises:
        TypeError: `init` is neither a grid nor a field.
        ValueError: a target that is NaN, not positive or of the wrong shape; times that the grid cannot resolve; an
            unknown choice; a checkpoint of another fit.
    """
    clock = time.perf_counter()
    if isinstance(init, Grid):
        init = flat_field(init)
    elif not isinstance(init, TensorField):
        raise TypeError(f"init: got {type(init).__name__}; expected hks_jax.Grid or hks_jax.TensorField")
    pencil = assemble(init, boundary)
    unknowns = unknowns_for(parametrisation, init, pencil.space.domain)
    observed, noise = observe(target, times, data, pencil.space, init.domain_tensors.dtype)

    def problem_of(observed: Observation, pairs: int) -> Problem:
        chosen = choose_for_fit(pencil, pairs) if solver == "auto" else solver
        return Problem(unknowns, observed, tuple(regularisers), pairs, boundary, chosen)

    problems = [
        problem_of(stage, stage.pairs_needed(k, pencil, init)) for stage in observed.stages(search.continuation)
    ]
    first, inner_product = unknowns.start(), choose_inner_product(unknowns, search.smoothness, noise)
    settings = {**vars(data), **vars(search), "max_steps": None}
    kind = unknowns.parametrisation.tensors if isinstance(unknowns, Nodal) else None
    mark = files.fingerprint(observed, unknowns, kind, regularisers, settings, repr((k, boundary)))
    now = files.Checkpoint(first, [], 0, 0, 1.0, first, [])
    if checkpoint is not None and Path(checkpoint).exists():
        now = files.load(checkpoint, mark)
        clock -= now.history[-1].seconds
    run = Run(search, first, noise, inner_product, now, progress, checkpoint, mark, clock)
    renewed = partial(problem_of, observed) if k is None else None
    reached, problem = run.with_enough_pairs(run.from_starts(problems), problems[-1], renewed)
    values, outcome, result = reached
    assert outcome is not None
    for message in outcome.pairs.messages():
        warn_of_accuracy(message)
    misfit, left = float(outcome.misfit), float(outcome.truncation)
    if truncation_shows(misfit, left):
        warn_of_accuracy(
            f"k: {problem.k} eigenpairs leave out a misfit of about {left:.1e}, and the fit's is {misfit:.1e}: "
            f"it has fitted its own truncation. Use k=None, or k={more_pairs(problem, values)} or "
            f"more; only if the target was itself computed with {problem.k} pairs is nothing wrong"
        )
    elif noise is not None and result in ("converged", "stalled") and misfit > noise**2:
        warn_of_accuracy(
            f"noise: the fit {result} at residuals of {(2 * misfit) ** 0.5:.2g}, of which noise explains {noise:.2g}: "
            "no metric of this parametrisation that it found explains the target. Use another parametrisation, such as "
            '"log-euclidean", another init or weaker regularisers; or the noise is larger. What the fit added '
            "to init may be the misfit's and not the metric's"
        )
    return MetricFit(
        unknowns.field(values),
        float(outcome.loss),
        misfit,
        left,
        tuple(now.history),
        result,
        values,
        problem,
        tuple(now.losses),
        noise,
    )
