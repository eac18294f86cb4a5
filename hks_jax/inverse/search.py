"""The search for unknowns: its methods and starts, stage by stage, with more eigenpairs where they are too few."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optimistix as optx

from hks_jax.inverse.checkpoint import Log
from hks_jax.inverse.conformal import (
    Euclidean,
    InnerProduct,
    Preconditioner,
    Smoothing,
    conformal_information,
    smoothing,
)
from hks_jax.inverse.gauss_newton import GaussNewton
from hks_jax.inverse.optimise import Optimiser, optimise
from hks_jax.inverse.parametrisation import Conformal
from hks_jax.inverse.problem import Outcome, Problem, more_pairs, observed_times, outcome_of, truncation_shows
from hks_jax.inverse.unknowns import Nodal, Unknowns, Values

OPTIMISERS = ("gauss-newton", "lbfgs", "bfgs")


def choose_inner_product(unknowns: Unknowns, smoothness: float | None, noise: float | None) -> InnerProduct:
    """Return that in which steps are small, of a given smoothness; see `hks_jax.fit_metric` for its default."""
    if not isinstance(unknowns, Nodal):
        return Euclidean()
    grid = unknowns.init.grid
    if smoothness is None:
        extent = max(h * (n - 1) for h, n in zip(grid.spacing, grid.shape, strict=True))
        smoothness = 0.1 * extent if unknowns.parametrisation.smooth or noise is not None else 0.0
    return smoothing(grid, smoothness, unknowns.init.domain_tensors.dtype)


def choose_optimiser(
    given: str | Optimiser,
    problem: Problem,
    tolerance: float,
    noise: float | None,
    inner_product: InnerProduct,
    step_size: float = 1.0,
) -> Optimiser:
    """Return the solver that one of `OPTIMISERS` stands for; a step size below 1 begins with as much more damping."""
    if given == "gauss-newton":
        # Against noise small steps: the misfit must not fall far below what the noise explains.
        damping, growth = (1e-4, 10.0) if noise is None else (1e-2, 3.0)
        preconditioner = _preconditioner(problem, inner_product)
        return GaussNewton(tolerance, damping / step_size, growth, inner_product, preconditioner=preconditioner)
    if given in ("lbfgs", "bfgs"):
        kind: Any = optx.LBFGS if given == "lbfgs" else optx.BFGS
        traced = jnp.asarray(tolerance)  # a static one would compile every stage anew
        return kind(traced, traced, optx.rms_norm)
    if isinstance(given, optx.AbstractLeastSquaresSolver | optx.AbstractMinimiser):
        return given
    names = ", ".join(map(repr, OPTIMISERS))
    raise ValueError(
        f"optimiser: got {given!r}; expected {names}, or a least squares solver or minimiser of optimistix"
    )


def _preconditioner(problem: Problem, inner_product: InnerProduct) -> Preconditioner:
    """Return what resembles JᵀJ where that is known, else the inner product."""
    unknowns, observation = problem.unknowns, problem.observation
    if isinstance(unknowns, Nodal) and isinstance(unknowns.parametrisation, Conformal):
        rough = isinstance(inner_product, Smoothing) and inner_product.factor is None
        if rough and observation.signature.name == "hks" and not problem.regularisers:
            return conformal_information(unknowns, inner_product, jnp.asarray(observed_times(observation)))
    return inner_product


_EARLY = 100.0
"""How many tolerances will do in the stages before the last, which need no last digits."""


class Reached(NamedTuple):
    """Where a search has come to."""

    values: Values  # the unknowns
    outcome: Outcome | None  # what a fit has come to with them; None where it is not known
    result: str  # one of the keys of `metric_fit.RESULTS`

    @property
    def stopped(self) -> bool:
        """Whether there is nothing to go on with."""
        return self.result in ("interrupted", "not finite")


@dataclasses.dataclass(frozen=True)
class Search:
    """How to search; see `hks_jax.fit_metric`."""

    optimiser: str | Optimiser  # a name or a solver
    tolerance: float  # what the unknowns still change at the end
    noise: float | None  # the standard deviation of the residuals that noise explains
    inner_product: InnerProduct  # in which steps are small
    max_steps: int  # of each stage
    log: Log  # what happens is told to it

    def solve(self, problem: Problem, values: Values, tolerances: float = 1.0, step_size: float = 1.0) -> Reached:
        """Solve one problem from given unknowns; the tolerances are multiplied by a factor."""
        tolerance = tolerances * self.tolerance
        method = choose_optimiser(self.optimiser, problem, tolerance, self.noise, self.inner_product, step_size)
        with jax.debug_nans(False):  # what nobody computed is told as NaN
            return Reached(*optimise(problem, values, method, self.noise, self.max_steps, self.log))

    def through_stages(self, problems: Sequence[Problem], values: Values, first: int, step_size: float) -> Reached:
        """Solve the problems from the first on, one after another; the outcome is that of the last of them."""
        reached, last = Reached(values, None, "interrupted"), len(problems) - 1
        now = self.log.now
        for now.stage in range(first, len(problems)):
            tolerances = 1.0 if now.stage == last else _EARLY
            reached = self.solve(problems[now.stage], reached.values, tolerances, step_size)
            step_size = 1.0
            if reached.stopped:
                break
        if reached.outcome is None or now.stage < last:
            reached = reached._replace(outcome=outcome_of(problems[-1], reached.values))
        return reached

    def from_starts(self, problems: Sequence[Problem], begin: Callable[[int], Values], starts: int) -> Reached:
        """Return the best of several starts: where the log stands, then at what `begin` returns for each number."""
        now, first = self.log.now, self.log.now.start
        where = jnp.asarray(now.values), now.stage, now.step_size
        if now.stage == len(problems):  # with more eigenpairs; no start is open any more
            return Reached(where[0], None, "converged")
        best = Reached(jnp.asarray(now.best), None, "interrupted")
        for now.start in range(first, starts):
            if now.start > first:
                where = begin(now.start), 0, 1.0
            reached = self.through_stages(problems, *where)
            assert reached.outcome is not None
            loss = float(reached.outcome.loss)
            if not now.losses or not loss >= min(now.losses):
                best, now.best = reached, reached.values
            now.losses.append(loss)
            if reached.result == "interrupted":
                break
        return best

    def with_enough_pairs(
        self, reached: Reached, problem: Problem, renewed: Callable[[int], Problem] | None
    ) -> tuple[Values, Outcome, str, Problem]:
        """Go on with more eigenpairs while what they leave out shows: they were chosen for the volume of the start.

        Returns the unknowns, their outcome, how it ended, and the problem with as many eigenpairs as it took.
        `renewed` makes it, of their number; None leaves that as it is.
        """
        while True:
            outcome = reached.outcome or outcome_of(problem, reached.values)
            shows = truncation_shows(float(outcome.misfit), float(outcome.truncation))
            if renewed is None or reached.stopped or not shows:
                break
            wanted = more_pairs(problem, reached.values)
            if wanted <= problem.k:
                break
            problem = renewed(wanted)
            reached = self.solve(problem, reached.values)
        return reached.values, outcome, reached.result, problem
