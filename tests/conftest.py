"""The suite runs in float64; tests/test_float32.py runs the whole path in float32."""

from pathlib import Path

import jax
import matplotlib
import numpy as np
import pytest

jax.config.update("jax_enable_x64", True)
# What one test process has compiled, the others need not.
jax.config.update("jax_compilation_cache_dir", str(Path(__file__).parent.parent / ".pytest_cache" / "jax"))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
matplotlib.use("Agg")


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20140101)
