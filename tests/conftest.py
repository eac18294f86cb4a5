"""The suite runs in float64; tests/test_float32.py runs the whole path in float32."""

import os
from pathlib import Path

import jax
import jaxlib
import matplotlib
import numpy as np
import pytest

# Tests are small and many: they wait for the compiler, which without these flags takes three times as long.
FLAGS = "--xla_backend_optimization_level=0"
if jaxlib.__version__.startswith("0.10."):  # an unknown flag would be fatal
    FLAGS += " --xla_cpu_use_fusion_emitters=false"
os.environ.setdefault("XLA_FLAGS", FLAGS)
jax.config.update("jax_enable_x64", True)
# What one test process has compiled, the others need not.
jax.config.update("jax_compilation_cache_dir", str(Path(__file__).parent.parent / ".pytest_cache" / "jax"))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
matplotlib.use("Agg")


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20140101)
