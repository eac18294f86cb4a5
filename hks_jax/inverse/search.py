"""The search for unknowns: from several starts, stage by stage, and with more eigenpairs where they are too few."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp

from hks_jax.inverse.checkpoint import Checkpoint
from hks_jax.inverse.log import Log
from hks_jax.inverse.method import choose_optimiser
from hks_jax.inverse.optimise import Optimiser, optimise
from hks_jax.inverse.problem import Problem
from hks_jax.inverse.smoothing import InnerProduct
from hks_jax.inverse.truncated import Outcome, more_pairs, outcome_of, truncation_shows
from hks_jax.inverse.unknowns import Values

_EARLY = 100.0
"""How many tolerances will do in the stages before the last, which need no last digits."""


class Reached(NamedTuple):
    """Where a search has come to.

    Attributes:
        values: the unknowns.
        outcome: what a fit has come to with them; None where it is not known.
        result: one of the keys of `metric_fit.RESULTS`.
    """

    values: Values
    outcome: Outcome | None
    result: str

    @property
    def stopped(self) -> bool:
        """Whether there is nothing to go on with."""
        return self.result in ("interrupted", "not finite")


@dataclasses.dataclass(frozen=True)
class Search:
    """How to search; see `hks_jax.fit_metric`.

    Attributes:
        optimiser: a name or a solver.
        tolerance: what the unknowns still change at the end.
        noise: the standard deviation of the residuals that noise explains.
        inner_product: in which steps are small.
        max_steps: of each stage.
        log: what happens is told to it.
    """

    optimiser: str | Optimiser
    tolerance: float
    noise: float | None
    inner_product: InnerProduct
    max_steps: int
    log: Log

    def solve(self, problem: Problem, values: Values, tolerances: float = 1.0, step_size: float = 1.0) -> Reached:
        """Solve one problem, beginning at some unknowns, to so many tolerances."""
        tolerance = tolerances * self.tolerance
        method = choose_optimiser(self.optimiser, problem, tolerance, self.noise, self.inner_product, step_size)
        with jax.debug_nans(False):  # what nobody computed is told as NaN
            return Reached(*optimise(problem, values, method, self.noise, self.max_steps, self.log))

    def through_stages(self, problems: Sequence[Problem], values: Values, first: int, step_size: float) -> Reached:
        """Solve the problems from the first on, one after another; the outcome is that of the last of them."""
        reached, last = Reached(values, None, "interrupted"), len(problems) - 1
        for self.log.stage in range(first, len(problems)):
            tolerances = 1.0 if self.log.stage == last else _EARLY
            reached = self.solve(problems[self.log.stage], reached.values, tolerances, step_size)
            step_size = 1.0
            if reached.stopped:
                break
        if reached.outcome is None or self.log.stage < last:
            reached = reached._replace(outcome=outcome_of(problems[-1], reached.values))
        return reached

    def from_starts(
        self, problems: Sequence[Problem], begin: Callable[[int], Values], starts: int, resumed: Checkpoint | None
    ) -> Reached:
        """Return the best of several starts.

        Args:
            problems: of the stages.
            begin: returns the unknowns at which a start begins.
            starts: how many there are.
            resumed: where to go on.
        """
        if resumed and resumed.stage == len(problems):  # with more eigenpairs; no start is open any more
            return Reached(jnp.asarray(resumed.values), None, "converged")
        best = Reached(self.log.best, None, "interrupted")
        for self.log.start in range(resumed.start if resumed else 0, starts):
            if resumed and self.log.start == resumed.start:
                where = jnp.asarray(resumed.values), resumed.stage, resumed.step_size
            else:
                where = begin(self.log.start), 0, 1.0
            reached = self.through_stages(problems, *where)
            assert reached.outcome is not None
            loss = float(reached.outcome.loss)
            if not self.log.losses or not loss >= min(self.log.losses):
                best, self.log.best = reached, reached.values
            self.log.losses.append(loss)
            if reached.result == "interrupted":
                break
        return best

    def with_enough_pairs(
        self, reached: Reached, problem: Problem, renewed: Callable[[int], Problem] | None
    ) -> tuple[Values, Outcome, str, Problem]:
        """Go on with more eigenpairs while what they leave out shows: they were chosen for the volume of the start.

        Args:
            reached: where the search has come to.
            problem: the last problem.
            renewed: returns it with another number of eigenpairs; None leaves that as it is.

        Returns:
            The unknowns, their outcome, how it ended, and the problem with as many eigenpairs as it took.
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
