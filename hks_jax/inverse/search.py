"""The search for unknowns: its methods and starts, stage by stage, with more eigenpairs where they are too few."""

import dataclasses
import os
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

from hks_jax.checks import require_count, require_number
from hks_jax.inverse.checkpoint import Checkpoint, save
from hks_jax.inverse.conformal import InnerProduct, Preconditioner, conformal_information, smoothing
from hks_jax.inverse.gauss_newton import GaussNewton
from hks_jax.inverse.metric_fit import Step
from hks_jax.inverse.optimise import Optimiser, Reached, optimise
from hks_jax.inverse.problem import Problem, more_pairs, outcome_of, truncation_shows
from hks_jax.inverse.signature import SIGNATURES
from hks_jax.inverse.unknowns import PARAMETRISATIONS, Nodal, Unknowns, Values, named

OPTIMISERS: dict[str, Any] = {"gauss-newton": GaussNewton, "lbfgs": optx.LBFGS, "bfgs": optx.BFGS}


@dataclasses.dataclass(frozen=True)
class Search:
    """How `hks_jax.fit_metric` looks for the metric, and when it stops.

    Attributes:
        optimiser: ``"gauss-newton"`` (damped, matrix-free), ``"lbfgs"``, ``"bfgs"``, or a solver of optimistix.
        smoothness: the length, in coordinate units, below which Gauss–Newton steps are smooth; 0 for no preference; by
            default a tenth of the domain, and 0 for ``"conformal"`` without noise.
        tolerance: a fit has converged when the unknowns u change by less than it, relative to 1 + |u| (root mean square
            over all of them). Both the last step and the sum of the steps to come, if the last two begin a geometric
            series, must be below it. The linear systems of steps that may be the last are solved 30 times more exactly,
            with three times as many products. Directions that the products do not find are left out:
            `identifiability` shows them. (Solvers of optimistix: the last step alone.)
        max_steps: steps per stage.
        continuation: stages: the first fits the largest times alone, the last all of them.
        starts: how often to start, the first time from the initial field, then from random smooth changes of it; the
            best wins.
        spread: their root mean square, in the parameters' units.
        seed: their seed.

    Raises:
        ValueError: an unknown optimiser; a number out of range.
    """

    optimiser: str | Optimiser = "gauss-newton"
    smoothness: float | None = None
    tolerance: float = 1e-4
    max_steps: int = 50
    continuation: int = 1
    starts: int = 1
    spread: float = 0.1
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the settings."""
        if not isinstance(self.optimiser, Optimiser):
            solvers = "or a least squares solver or minimiser of optimistix"
            named("optimiser", self.optimiser, OPTIMISERS, solvers)
        for name in ("max_steps", "continuation", "starts"):
            require_count(name, getattr(self, name))
        require_number("tolerance", self.tolerance, 1)
        require_number("spread", self.spread, inclusive=True)
        if self.smoothness is not None:
            require_number("smoothness", self.smoothness, inclusive=True)


def choose_inner_product(unknowns: Unknowns, smoothness: float | None, noise: float | None) -> InnerProduct:
    """Return the inner product in which steps are small, for a smoothness; see `Search` for its default."""
    if not isinstance(unknowns, Nodal):
        return InnerProduct()
    grid = unknowns.init.grid
    if smoothness is None:
        extent = max(h * (n - 1) for h, n in zip(grid.spacing, grid.shape, strict=True))
        smoothness = 0.1 * extent if unknowns.parametrisation.smooth or noise is not None else 0.0
    return smoothing(grid, smoothness, unknowns.init.domain_tensors.dtype)


_EARLY = 100.0
"""How many tolerances will do in the stages before the last, which need no last digits."""


@dataclasses.dataclass(frozen=True)
class Run:
    """One search, from the unknowns `first` on."""

    search: Search  # its settings
    first: Values  # the unknowns of the initial field
    noise: float | None  # the standard deviation of the residuals that noise explains
    inner_product: InnerProduct  # in which steps are small
    now: Checkpoint  # where the fit stands
    progress: Callable[[Step], None] | None  # called with each step
    path: str | os.PathLike[str] | None  # of the checkpoint
    mark: str  # a hash of data and settings
    clock: float  # when the fit began, by `time.perf_counter`

    def told(
        self, number: int, told: tuple[float, float, float], accepted: bool, values: Values, step_size: float
    ) -> None:
        """Take up a step by its number within the stage: loss, misfit and gradient, and whether it was taken."""
        now, seconds = self.now, time.perf_counter() - self.clock
        now.values, now.step_size = values, step_size
        now.history.append(Step(number, *told, accepted, seconds, now.stage, now.start))
        if self.progress is not None:
            self.progress(now.history[-1])
        if self.path is not None:
            save(self.path, self.mark, now)

    def solve(self, problem: Problem, values: Values, tolerances: float = 1.0, step_size: float = 1.0) -> Reached:
        """Solve one problem from given unknowns; the tolerances are multiplied by a factor."""
        method = self._optimiser(problem, tolerances * self.search.tolerance, step_size)
        with jax.debug_nans(False):  # numbers that were not computed are NaN
            return optimise(problem, values, method, self.noise, self.search.max_steps, self.told)

    def _optimiser(self, problem: Problem, tolerance: float, step_size: float) -> Optimiser:
        """Return the solver; a step size below 1 begins with as much more damping."""
        given = self.search.optimiser
        if not isinstance(given, str):
            return given
        if given == "gauss-newton":
            # Small steps against noise: the misfit must not fall far below it.
            damping, growth = (1e-4, 10.0) if self.noise is None else (1e-2, 3.0)
            preconditioner = self._preconditioner(problem)
            return GaussNewton(
                tolerance, damping / step_size, growth, self.inner_product, preconditioner=preconditioner
            )
        traced = jnp.asarray(tolerance)  # a static one would compile every stage anew
        return OPTIMISERS[given](traced, traced, optx.rms_norm)

    def _preconditioner(self, problem: Problem) -> Preconditioner:
        """Return an approximation of JᵀJ where one is known, else the inner product."""
        unknowns, observation = problem.unknowns, problem.observation
        if isinstance(unknowns, Nodal) and unknowns.parametrisation == PARAMETRISATIONS["conformal"]:
            rough = getattr(self.inner_product, "factor", None) is None
            if rough and observation.signature == SIGNATURES["hks"] and not problem.regularisers:
                times = jnp.asarray(np.unique(observation.observed_times))
                return conformal_information(unknowns, self.inner_product, times)
        return self.inner_product

    def through_stages(self, problems: Sequence[Problem], values: Values, first: int, step_size: float) -> Reached:
        """Solve the problems from the first on, one after another; the outcome is that of the last of them."""
        reached, last = Reached(values, None, "interrupted"), len(problems) - 1
        now = self.now
        for now.stage in range(first, len(problems)):
            tolerances = 1.0 if now.stage == last else _EARLY
            reached = self.solve(problems[now.stage], reached.values, tolerances, step_size)
            step_size = 1.0
            if reached.stopped:
                break
        if reached.outcome is None or now.stage < last:
            reached = reached._replace(outcome=outcome_of(problems[-1], reached.values))
        return reached

    def from_starts(self, problems: Sequence[Problem]) -> Reached:
        """Return the best of several starts: where the log stands, then at random changes of the first unknowns."""
        now, start = self.now, self.now.start
        where = jnp.asarray(now.values), now.stage, now.step_size
        if now.stage == len(problems):  # with more eigenpairs; no start is open any more
            return Reached(where[0], None, "converged")
        best = Reached(jnp.asarray(now.best), None, "interrupted")
        for now.start in range(start, self.search.starts):
            if now.start > start:
                where = self._moved(now.start), 0, 1.0
            reached = self.through_stages(problems, *where)
            assert reached.outcome is not None
            loss = float(reached.outcome.loss)
            if not now.losses or not loss >= min(now.losses):
                best, now.best = reached, reached.values
            now.losses.append(loss)
            if reached.result == "interrupted":
                break
        now.stage, now.best = len(problems), best.values
        return best

    def _moved(self, start: int) -> Values:
        """Return the values to begin a further start with, the first ones with smooth noise."""
        key = jax.random.fold_in(jax.random.key(self.search.seed), start)
        noise = self.inner_product.solve(jax.random.normal(key, self.first.shape, self.first.dtype))
        return self.first + self.search.spread * noise / jnp.sqrt(jnp.mean(noise**2))

    def with_enough_pairs(
        self, reached: Reached, problem: Problem, renewed: Callable[[int], Problem] | None
    ) -> tuple[Reached, Problem]:
        """Go on with more eigenpairs while their truncation shows: they were chosen for the volume of the start.

        `renewed` makes the problem of their number; None leaves it as it is.
        """
        while True:
            outcome = reached.outcome or outcome_of(problem, reached.values)
            reached = reached._replace(outcome=outcome)
            shows = truncation_shows(float(outcome.misfit), float(outcome.truncation))
            if renewed is None or reached.stopped or not shows:
                return reached, problem
            wanted = more_pairs(problem, reached.values)
            if wanted <= problem.k:
                return reached, problem
            problem = renewed(wanted)
            reached = self.solve(problem, reached.values)
