"""Messages of the library in the words of the command line: arguments as options."""

import re
from collections.abc import Iterable

READING = ("order", "frame", "array", "spacing", "confidence", "mask", "components", "repair", "unit", "bvec_frame")
"""The options of the commands that read tensors."""

OPTIONS = (
    *READING,
    *("k", "boundary", "metric", "solver", "times", "through", "interpolation", "normalisation", "method"),
    *("erode", "slice", "bval", "bvec", "b_max"),
)
"""Those that arguments of the library correspond to."""


def as_options(message: str, names: Iterable[str]) -> str:
    """Return a message in which the named arguments of the library are spelled as the options of a command.

    ``Pass array`` becomes ``Pass --array``, ``pass frame "fsl"`` and ``pass frame="fsl"`` become ``pass --frame fsl``,
    and ``k: got 0`` at the beginning becomes ``-k: got 0``.
    """
    for name in names:
        option = ("-" if len(name) == 1 else "--") + name.replace("_", "-")
        message = re.sub(rf"^{re.escape(name)}: ", f"{option}: ", message)
        argument = rf"\b([Pp]ass|[Cc]hoose|or|try) {re.escape(name)}\b(?! [a-z])(?: \({option}\))?"
        message = re.sub(rf'{argument}(?: |=|: )"([\w/-]+)"', rf"\1 {option} \2", message)
        message = re.sub(argument, rf"\1 {option}", message)
    return message.replace("clean=True puts right what it can: see read_mesh", "--clean puts right what it can")
