"""How long a subspace iteration still takes, from the rounds that it has done."""

import math
import time


class Pace:
    """The convergence and the cost of the rounds so far.

    The largest defect falls by about the same factor in every round, and a round takes time in proportion to the
    products that its polynomials have. Nothing is estimated before one round is over.
    """

    def __init__(self, excess: float) -> None:
        """Begin with the largest defect, as a multiple of what counts as converged."""
        self._excess, self._factor = excess, math.nan
        self._work, self._seconds = math.nan, math.nan
        self._begin = time.perf_counter()

    def round_done(self, excess: float, work: int) -> None:
        """Remember a round of so many products, and the defect after it."""
        now = time.perf_counter()
        self._factor, self._excess = self._excess / excess if excess > 0 else math.inf, excess
        self._work, self._seconds, self._begin = work, now - self._begin, now

    def seconds_left(self, done: int = 0, work: int = 0) -> float | None:
        """Return what is left, a round with so many products done of so many being under way; None where unknown.

        Of a round that is not under way, nothing is done, and the work is taken for that of the last.
        """
        if not self._factor > 1 or not self._excess > 1:
            return None
        rounds = math.ceil(math.log(self._excess) / math.log(self._factor))
        # Later rounds have fewer pairs to filter: this one's work, where it is known, is the better guess for all.
        per_round = self._seconds * ((work or self._work) / self._work if self._work else 1.0)
        return (rounds - (done / work if work else 0.0)) * per_round
