"""The search for the unknowns of a fit: optimisers, initial guesses, stages and the number of eigenpairs."""

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
from hks_jax.inverse.conformal import ConformalInformation, InnerProduct, conformal_information, smoothing
from hks_jax.inverse.gauss_newton import GaussNewton
from hks_jax.inverse.metric_fit import Step
from hks_jax.inverse.optimise import Optimiser, Reached, optimise
from hks_jax.inverse.problem import Problem, more_pairs, outcome_of, truncation_shows
from hks_jax.inverse.signature import SIGNATURES
from hks_jax.inverse.unknowns import PARAMETRISATIONS, Nodal, Unknowns, Values, named

OPTIMISERS: dict[str, Any] = {"gauss-newton": GaussNewton, "lbfgs": optx.LBFGS, "bfgs": optx.BFGS}


@dataclasses.dataclass(frozen=True)
class Search:
    """The settings of the optimisation in `hks_jax.fit_metric` and its stopping criteria.

    Attributes:
        optimiser: ``"gauss-newton"`` (damped, matrix-free), ``"lbfgs"``, ``"bfgs"``, or a solver of optimistix.
        smoothness: the length, in coordinate units, below which Gauss–Newton steps are smooth, or 0 for steps without
            smoothing. The default length is a tenth of the grid's longest side, or 0 for ``"conformal"`` without noise.
        tolerance: a fit has converged when the unknowns u change by less than the tolerance, relative to 1 + |u| (root
            mean square). The last step and the predicted sum of all future steps must both be below the tolerance. If a
            step may be the last, conjugate gradients solve its linear system 30 times more accurately, in up to 3 times
            as many iterations. `identifiability` finds changes of the unknowns that hardly affect the data, for which
            convergence is not tested. For solvers of optimistix, only the last step must be below the tolerance.
        max_steps: the maximum number of steps in each stage.
        continuation: the number of stages. The first stage fits only the largest times, the last stage fits all times.
        starts: the number of initial guesses: the initial field and its random smooth changes. The best fit is kept.
        spread: the root mean square of the random changes of the initial field, in the parameters' units.
        seed: the seed of the random changes of the initial field.

    Raises:
        ValueError: if the optimiser is unknown or a number is out of range.

    Examples:
        >>> search = hj.inverse.Search(optimiser="bfgs", tolerance=1e-5)
        >>> scaled = hj.inverse.Free(lambda s: s * field.tensors, jnp.array(1.1))
        >>> print(hj.fit_metric(field, hj.hks(pairs, [0.2, 0.5]), [0.2, 0.5], scaled, search=search).values.round(3))
        [1.]
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
    """Return the inner product for the damping of steps. `Search` documents the default smoothness."""
    if not isinstance(unknowns, Nodal):
        return InnerProduct()
    grid = unknowns.init.grid
    if smoothness is None:
        extent = max(h * (n - 1) for h, n in zip(grid.spacing, grid.shape, strict=True))
        smoothness = 0.1 * extent if unknowns.parametrisation.smooth or noise is not None else 0.0
    return smoothing(unknowns, smoothness)


_EARLY = 100.0
"""The tolerance is 100 times larger in all stages except the last, because earlier stages need less accuracy."""


@dataclasses.dataclass(frozen=True)
class Run:
    """One search for unknowns, which starts from the unknowns `first`."""

    search: Search  # the settings
    first: Values  # the unknowns of the initial field
    noise: float | None  # the standard deviation of the residuals due to noise
    inner_product: InnerProduct  # the inner product for the damping of steps
    now: Checkpoint  # the state of the fit
    progress: Callable[[Step], None] | None  # called with each step
    path: str | os.PathLike[str] | None  # the path of the checkpoint
    mark: str  # a hash of data and settings
    clock: float  # the time when the fit began, by `time.perf_counter`

    def record(
        self, number: int, numbers: tuple[float, float, float], accepted: bool, values: Values, step_size: float
    ) -> None:
        """Record and report a step of a stage with its number, loss, misfit, gradient and acceptance."""
        now, seconds = self.now, time.perf_counter() - self.clock
        now.values, now.step_size = values, step_size
        now.history.append(Step(number, *numbers, accepted, seconds, now.stage, now.start))
        if self.progress is not None:
            self.progress(now.history[-1])
        if self.path is not None:
            save(self.path, self.mark, now)

    def solve(self, problem: Problem, values: Values, tolerances: float = 1.0, step_size: float = 1.0) -> Reached:
        """Solve a problem from given unknowns, with the tolerance times `tolerances` and damping over `step_size`."""
        method, tolerance = self.search.optimiser, tolerances * self.search.tolerance
        if method == "gauss-newton":
            # Noisy data require small steps, because the misfit must not fall far below the noise.
            damping, growth = (1e-4, 10.0) if self.noise is None else (1e-2, 3.0)
            known, preconditioner = self.inner_product, self._preconditioner(problem)
            method = GaussNewton(tolerance, damping / step_size, growth, known, preconditioner=preconditioner)
        elif isinstance(method, str):
            traced = jnp.asarray(tolerance)  # a static value would cause a compilation for every stage
            method = OPTIMISERS[method](traced, traced, optx.rms_norm)
        with jax.debug_nans(False):  # values that were not computed are NaN
            return optimise(problem, values, method, self.noise, self.search.max_steps, self.record)

    def _preconditioner(self, problem: Problem) -> InnerProduct | ConformalInformation:
        unknowns, observation = problem.unknowns, problem.observation
        if isinstance(unknowns, Nodal) and unknowns.parametrisation == PARAMETRISATIONS["conformal"]:
            rough = getattr(self.inner_product, "factor", None) is None
            if rough and observation.signature == SIGNATURES["hks"] and not problem.regularisers:
                times = jnp.asarray(np.unique(observation.observed_times))
                return conformal_information(unknowns, self.inner_product, times)
        return self.inner_product

    def through_stages(self, problems: Sequence[Problem], values: Values, first: int, step_size: float) -> Reached:
        """Solve the problems of successive stages from the index `first`; return the result of the last stage."""
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
        """Return the best fit from several initial guesses: the recorded state, and random changes of `first`."""
        now, start = self.now, self.now.start
        where = jnp.asarray(now.values), now.stage, now.step_size
        if now.stage == len(problems):  # all initial guesses were tried before the fit was interrupted
            return Reached(where[0], None, now.ended)
        best = Reached(jnp.asarray(now.best), None, now.ended)
        for now.start in range(start, self.search.starts):
            if now.start > start:
                where = self._moved(now.start), 0, 1.0
            reached = self.through_stages(problems, *where)
            assert reached.outcome is not None
            loss = float(reached.outcome.loss)
            if not now.losses or loss < np.fmin.reduce([np.inf, *now.losses]):  # ignores losses that are NaN
                best, now.best, now.ended = reached, reached.values, reached.result
            now.losses.append(loss)
            if reached.result == "interrupted":
                return best._replace(result="interrupted")
        now.stage, now.best = len(problems), best.values
        return best

    def _moved(self, start: int) -> Values:
        """Return a random initial guess, which is the unknowns of the initial field plus smooth noise."""
        key = jax.random.fold_in(jax.random.key(self.search.seed), start)
        noise = self.inner_product.solve(jax.random.normal(key, self.first.shape, self.first.dtype))
        return self.first + self.search.spread * noise / jnp.sqrt(jnp.mean(noise**2))

    def with_enough_pairs(
        self, reached: Reached, problem: Problem, renewed: Callable[[int], Problem] | None
    ) -> tuple[Reached, Problem]:
        """Continue with more eigenpairs while truncation affects the fit, because the volume may have grown.

        `renewed` returns the problem with a given number of eigenpairs; if `renewed` is None, the number is kept.
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
