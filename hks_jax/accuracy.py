"""The warning class for results with limited accuracy."""

import sys
import warnings


class AccuracyWarning(UserWarning):
    """A warning that a result has limited accuracy. The message states the cause and the remedy.

    ``warnings.simplefilter("error", hks_jax.AccuracyWarning)`` turns this warning into an error.
    """


def warn_of_accuracy(message: str, category: type[Warning] = AccuracyWarning) -> None:
    """Issue a warning that points to the line of the user's code that called this package."""
    # If annotations are checked at run time, calls inside the package pass through jaxtyping.
    inside, level = {__name__.partition(".")[0], "jaxtyping"}, 2
    frame = sys._getframe(1)
    while frame.f_back is not None and frame.f_globals.get("__name__", "").partition(".")[0] in inside:
        frame, level = frame.f_back, level + 1
    warnings.warn(message, category, stacklevel=level)
