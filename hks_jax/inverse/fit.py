"""Fit a metric to a signature."""

import os
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from hks_jax.accuracy import warn_of_accuracy
from hks_jax.domain.grid import Grid
from hks_jax.domain.simplicial_mesh import SimplicialMesh
from hks_jax.domain.tensor_field import TensorField
from hks_jax.eigen.automatic import choose_for_fit
from hks_jax.eigen.solver import Eigensolver
from hks_jax.fem.assembly import assemble
from hks_jax.fem.boundary import BoundarySpec
from hks_jax.fem.space import GridSpace
from hks_jax.inverse import checkpoint as files
from hks_jax.inverse.metric_fit import MetricFit, Step
from hks_jax.inverse.observation import Data, Observation, observe
from hks_jax.inverse.problem import Problem, discretisation_misfit, more_pairs, truncation_shows
from hks_jax.inverse.regulariser import Regulariser
from hks_jax.inverse.search import Run, Search, choose_inner_product
from hks_jax.inverse.unknowns import Free, Parametrisation, flat_field, unknowns_for

_EXPLAINED = 1e-6
"""A misfit above this share of the discretisation's counts as not explained: residuals above a thousandth of its error.
On the same grid, fits of a metric that explains the target ended with residuals of 2e-9 to 7e-5 of the error, fits to
targets of a finer grid or of a metric beyond the parametrisation with residuals of 1e-2 and more.
Residuals below twice the tolerance of the search do not count, because the fit stops there."""
_FALLING = 0.8
"""A fit whose last step reduced the loss below this share had not ended when its steps were exhausted."""
_UNEXPLAINED = (
    "The fitted metric does not explain the target, and its differences from init may be artefacts. Use another "
    'parametrisation, such as "log-euclidean", another init'
)


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
    """Find a metric with a given signature.

    The fit minimises half the weighted mean square of the differences between predicted and given signature, plus the
    penalties of the regularisers. Because isometric metrics have the same signature, and high frequencies of a metric
    affect its signature little, the steps of the fit are damped and, by default, smooth. Damped steps first change
    those combinations of unknowns that the data determine. A fit that stalls or is interrupted raises no error; the
    result states how the fit ended.

    Args:
        init: the initial metric: a field, or a grid for the flat metric. The fit keeps properties of the field that the
            parametrisation does not change.
        target: ``hks(pairs, times)`` (n_times, *grid.shape) of the unknown metric, positive at observed nodes. A wave
            kernel signature is (n_energies, *grid.shape), a heat trace (n_times,), and eigenvalues are (m,) in
            ascending order, including zeros.
        times: (n_times,) times, or the energies of a wave kernel signature; None if the signature has neither.
        parametrisation: ``"log-euclidean"`` or ``"cholesky"`` (the whole tensor), ``"conformal"`` (a factor of the
            tensors of `init`), ``"eigenvalues"`` (with the eigenvectors of `init`), ``"rotation"`` (with the
            eigenvalues of `init`), a `Parametrisation`, or `Free` parameters of a function.
        data: the kind of signature, the measure of differences, and the weights and noise of entries.
        regularisers: penalties from `hks_jax.inverse`: `H1`, `TotalVariation`, `LogDeterminant`, `Prior`.
        k: the number of eigenpairs. By default, eigenpairs beyond k contribute a share of 1e-6 to the heat trace at the
            smallest time, by Weyl's law. If the grid has too few nodes for this share, the default k is maximal. The
            default k increases if the fit reaches a field of more volume. For a wave kernel signature of width σ, the
            default k includes energies up to 2σ above the largest one of `times`.
        boundary: the same as for `eigenpairs`.
        solver: the eigensolver; ``"auto"`` chooses a solver that suits many products with one Jacobian.
        search: the settings of the optimisation and its stopping criteria.
        progress: a function, such as ``print``, that is called with each step.
        checkpoint: a file that is written after each step. If the file exists, the fit resumes from it.

    Warns:
        AccuracyWarning: if the misfit is close to the truncation error of k pairs, so that the fitted metric may
            compensate for truncation. If the fit ended, or its last step hardly improved it: if the misfit is above the
            noise, so that the metric misses the target; or, without noise, if the residuals are above a thousandth of
            the discretisation error.

    Raises:
        TypeError: if `init` is neither a grid nor a field, such as a mesh, on which no metric can be fitted.
        ValueError: if the target is NaN, not positive or of the wrong shape, if the grid cannot resolve a time, if an
            option is unknown, or if the checkpoint belongs to another fit.

    Examples:
        >>> larger = hj.TensorField(field.grid, 1.1 * field.tensors)
        >>> fit = hj.fit_metric(larger, hj.hks(pairs, [0.2, 0.5]), [0.2, 0.5], "conformal")
        >>> np.allclose(fit.field.tensors, field.tensors, atol=0.01)
        True
    """
    clock = time.perf_counter()
    if isinstance(init, Grid):
        init = flat_field(init)
    elif not isinstance(init, TensorField):
        remedy = ""
        if isinstance(init, SimplicialMesh):
            remedy = (
                ". A metric can be fitted on grids only. Minimise a loss of hks(eigenpairs(mesh, k), times) by "
                "jax.value_and_grad with respect to the mesh's vertices or metric, or sample the domain on a grid"
            )
        raise TypeError(f"init: got {type(init).__name__}; expected hks_jax.Grid or hks_jax.TensorField{remedy}")
    if isinstance(regularisers, Regulariser):
        name = type(regularisers).__name__
        raise TypeError(f"regularisers: got one {name}; expected a list of penalties, such as [{name}(…)]")
    pencil = assemble(init, boundary)
    space = pencil.space
    assert isinstance(space, GridSpace)
    unknowns = unknowns_for(parametrisation, init, space)
    observed, noise = observe(target, times, data, space, init.domain_tensors.dtype)

    def problem_of(observed: Observation, pairs: int) -> Problem:
        chosen = choose_for_fit(pencil, pairs) if solver == "auto" else solver
        return Problem(unknowns, observed, tuple(regularisers), pairs, boundary, chosen)

    problems = [problem_of(each, each.pairs_needed(k, pencil, init)) for each in observed.stages(search.continuation)]
    first, inner_product = unknowns.start(), choose_inner_product(unknowns, search.smoothness, noise)
    settings = {**vars(data), **vars(search), "max_steps": None}
    at_first = unknowns.field(first).domain_tensors  # functions are hashed by name only
    mark = files.fingerprint(observed, unknowns, regularisers, settings, repr((k, boundary)), at_first)
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
    misfit, left, discretisation = (
        float(outcome.misfit),
        float(outcome.truncation),
        discretisation_misfit(problem, outcome),
    )
    last = [step.loss for step in now.history[-2:]]
    exhausted = result == "steps exhausted" and last[-1] > _FALLING * last[0]
    ended = result in ("converged", "stalled") or exhausted
    if truncation_shows(misfit, left):
        warn_of_accuracy(
            f"k: the truncation to {problem.k} eigenpairs causes a misfit of about {left:.1e}, and the fit's misfit "
            f"is {misfit:.1e}. So the fitted metric may compensate for the truncation. Use k=None, or "
            f"k={more_pairs(problem, values)} or more, unless the target was computed with {problem.k} pairs"
        )
    elif noise is not None and ended and misfit > noise**2:
        warn_of_accuracy(
            f"noise: the fit ended ({result}) with residuals of {(2 * misfit) ** 0.5:.2g}, above the noise "
            f"{noise:.2g}. {_UNEXPLAINED}, weaker regularisers, or a larger noise"
        )
    elif noise is None and ended and misfit > np.fmax(_EXPLAINED * discretisation, 2 * search.tolerance**2):
        size, error = (2 * misfit) ** 0.5, (2 * discretisation) ** 0.5
        why = "not explained by the metric"
        if not np.isnan(error):
            why = "above" if misfit > discretisation else f"{why}, beside"
            why += f" the discretisation error of about {error:.2g}"
        warn_of_accuracy(
            f"target: the fit ended ({result}) with residuals of {size:.2g}, {why}. {_UNEXPLAINED}, more steps, or "
            f"weaker regularisers. If the target was measured, or computed on another grid, pass its error as noise: "
            f"at least {np.fmax(size, error):.2g}"
        )
    field, history, losses = unknowns.field(values), tuple(now.history), tuple(now.losses)
    return MetricFit(field, float(outcome.loss), misfit, left, history, result, values, problem, losses, noise)
