"""What has happened in a fit so far."""

import dataclasses
import os
import time
from collections.abc import Callable

from hks_jax.inverse import checkpoint as files
from hks_jax.inverse.metric_fit import Step
from hks_jax.inverse.unknowns import Values


@dataclasses.dataclass
class Log:
    """What happened so far; called after each step, it tells and saves it.

    Attributes:
        progress: called with each step.
        path: of the checkpoint.
        mark: of what fit it is.
        best: the best unknowns of the starts before.
        clock: when the fit began, by `time.perf_counter`.
        history: the steps.
        losses: of the starts before.
        start: which of the starts is under way,
        stage: and which stage of it.
    """

    progress: Callable[[Step], None] | None
    path: str | os.PathLike[str] | None
    mark: str
    best: Values
    clock: float
    history: list[Step] = dataclasses.field(default_factory=list)
    losses: list[float] = dataclasses.field(default_factory=list)
    start: int = 0
    stage: int = 0

    def __call__(
        self, number: int, told: tuple[float, float, float], accepted: bool, values: Values, step_size: float
    ) -> None:
        """Take up a step.

        Args:
            number: of the step, within the stage.
            told: loss, misfit, and the norm of the gradient.
            accepted: whether the step was taken.
            values: the unknowns.
            step_size: the solver's.
        """
        seconds = time.perf_counter() - self.clock
        self.history.append(Step(number, *told, accepted, seconds, self.stage, self.start))
        if self.progress is not None:
            self.progress(self.history[-1])
        if self.path is not None:
            now = files.Checkpoint(values, self.history, self.start, self.stage, step_size, self.best, self.losses)
            files.save(self.path, self.mark, now)
