"""The warning class for results that are right only to a stated accuracy."""


class AccuracyWarning(UserWarning):
    """A result was returned, but something limits its accuracy: the message says what, and the remedy.

    Make it an error with ``warnings.simplefilter("error", hks_jax.AccuracyWarning)``.
    """
