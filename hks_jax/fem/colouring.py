"""Colours of nodes such that those of one colour are far apart: one vector then probes all of them."""

import numpy as np
from jaxtyping import Int


def axis_colours(n: int, spacing: int, wraps: bool) -> Int[np.ndarray, " n"]:
    """Return colours along one axis: nodes of one colour are ``spacing`` or more apart."""
    if not wraps:
        return np.arange(n) % min(spacing, n)
    # As many runs as fit, some a node longer than others: the first of one run is `spacing` or more after the last.
    runs = max(n // spacing, 1)
    return np.concatenate([np.arange(len(run)) for run in np.array_split(np.arange(n), runs)])
