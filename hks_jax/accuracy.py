"""The warning class for results that are right only to a stated accuracy."""

import sys
import warnings


class AccuracyWarning(UserWarning):
    """A result was returned, but something limits its accuracy: the message says what, and the remedy.

    Make it an error with ``warnings.simplefilter("error", hks_jax.AccuracyWarning)``.
    """


def warn_of_accuracy(message: str, category: type[Warning] = AccuracyWarning) -> None:
    """Warn at the line outside this package that led here, of accuracy or of what another category says."""
    # Where annotations are checked at run time, calls inside the package pass through jaxtyping.
    inside, level = {__name__.partition(".")[0], "jaxtyping"}, 2
    frame = sys._getframe(1)
    while frame.f_back is not None and frame.f_globals.get("__name__", "").partition(".")[0] in inside:
        frame, level = frame.f_back, level + 1
    warnings.warn(message, category, stacklevel=level)
