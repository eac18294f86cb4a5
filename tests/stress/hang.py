"""Programs of two beside each other under one `jit`, a hundred calls on 1, 2 or 4 threads: they must end.

Each runs in a process of its own with a time limit.
"""

import numpy as np
from concurrent_programs import PROGRAMS, run

from .harness import Outcome

NAMES = [name for name in PROGRAMS if name not in ("fit", "gradients on devices")]


def check(seed: int) -> Outcome:
    """Run two random programs as one."""
    rng = np.random.default_rng(seed)
    run([" + ".join(rng.choice(NAMES, 2))], threads=int(rng.choice([1, 2, 4])), devices=int(rng.choice([1, 2])))
    return "right"
