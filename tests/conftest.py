"""The suite runs in float64, with shapes checked; tests/signatures/test_float32.py runs the whole path in float32."""

import gc
import os
import resource
from collections.abc import Iterator
from pathlib import Path

import jax
import jaxtyping
import matplotlib
import numpy as np
import pytest
from compiler_flags import FLAGS

# From here on every call of a function of the package is checked against its annotations, shapes included.
jaxtyping.install_import_hook("hks_jax", "annotations.checked")

os.environ.setdefault("XLA_FLAGS", " ".join(FLAGS))
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
# What one test process has compiled, the others need not.
jax.config.update("jax_compilation_cache_dir", str(Path(__file__).parent.parent / ".pytest_cache" / "jax"))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
# Where each operation came from, frame by frame, nobody reads here, and it takes a tenth of the time to write down.
jax.config.update("jax_traceback_in_locations_limit", 0)
os.environ.setdefault("JAX_TRACEBACK_IN_LOCATIONS_LIMIT", "0")  # nor in the processes that tests start
# Tracing makes many objects that live, among which the collector, at its usual pace, looks for garbage in vain.
gc.set_threshold(200_000, 20, 50)
matplotlib.use("Agg")


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20140101)


def resident() -> int:
    """Return the memory that the process has, in bytes, or where the system does not tell, the most that it had."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10


enough = 3 << 30


@pytest.fixture(autouse=True, scope="module")
def forget_what_was_compiled() -> Iterator[None]:
    """Clear the caches when the process has come to 3 GiB: a thousand tests compile more than fits into memory.

    Clearing takes seconds, and freed memory is used again first; so caches are cleared only if the process has grown.
    """
    global enough
    yield
    if resident() > enough:
        jax.clear_caches()
        gc.collect()
        enough = max(enough, resident() + (1 << 29))
