"""What a check is, and how many of them are run."""

import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import count
from typing import Literal

import jax

_FORGET = 250
"""Checks after which compiled programs are forgotten: a process cannot hold tens of thousands."""

Outcome = Literal["right", "told", "refused"]
"""A right answer; a limited or wrong one that a warning, a code or NaN tells of; a clear error instead of an answer."""

Check = Callable[[int], Outcome]
"""What one seed stands for. It raises AssertionError for what is wrong and silent, and lets no other error pass."""


@dataclass
class Tally:
    """How the checks of one kind went."""

    outcomes: Counter[str] = field(default_factory=Counter)
    failures: list[str] = field(default_factory=list)
    seconds: float = 0.0

    def row(self, kind: str) -> dict[str, str | int]:
        """Return the numbers as a row of a result file."""
        names = ("right", "told", "refused", "failed")
        counts = {name: self.outcomes[name] for name in names}
        return {"kind": kind, "checks": self.outcomes.total(), **counts, "seconds": round(self.seconds)}


def run(kind: str, check: Check, seeds: Iterator[int], seconds: float, report: Callable[[str], None]) -> Tally:
    """Run checks until the seeds or the time are used up; a failure is reported with its reproducer."""
    tally, start = Tally(), time.perf_counter()
    for done, seed in enumerate(seeds, start=1):
        if done % _FORGET == 0:
            jax.clear_caches()
        try:
            tally.outcomes[check(seed)] += 1
        except Exception as error:
            tally.outcomes["failed"] += 1
            tally.failures.append(f"{kind} {seed}: {type(error).__name__}: {error}")
            if not isinstance(error, AssertionError):
                report(traceback.format_exc(limit=-3))
            report(f"{tally.failures[-1]}\n    PYTHONPATH=tests python -m stress {kind} --seed {seed}")
        tally.seconds = time.perf_counter() - start
        if tally.seconds > seconds:
            break
    return tally


def seeds(first: int, number: int | None) -> Iterator[int]:
    """Return as many seeds as are asked for, or endlessly many."""
    return iter(range(first, first + number)) if number else count(first)
