"""Importing the package must leave JAX, and everything else, as it was."""

import subprocess
import sys

import pytest

CHECK = """
import warnings
warnings.simplefilter("error")
import jax
before = dict(jax.config.values)
import hks_jax
hks_jax.hks, hks_jax.Grid((4, 5), 0.5)
after = dict(jax.config.values)
assert before == after, {k: (before.get(k), v) for k, v in after.items() if before.get(k) != v}
"""

BACKENDS = """
import os
os.environ["JAX_PLATFORMS"] = "no_such_platform"  # the first computation would raise
import hks_jax
grid = hks_jax.Grid((4, 5), 0.5, mask=None)
import jax
try:
    jax.numpy.zeros(3)
except RuntimeError:
    print("untouched")
"""

LAZY = """
import sys
import hks_jax
assert "matplotlib" not in sys.modules
assert "nibabel" not in sys.modules and "dipy" not in sys.modules
assert hks_jax.plot.__name__ == "hks_jax.plot"
assert hks_jax.examples.__name__ == "hks_jax.domain.examples"
"""


@pytest.mark.parametrize("script", [CHECK, LAZY], ids=["configuration", "lazy"])
def test_import_changes_nothing(script):
    subprocess.run([sys.executable, "-c", script], check=True, capture_output=True, text=True)


def test_import_initialises_no_backend():
    done = subprocess.run([sys.executable, "-c", BACKENDS], check=True, capture_output=True, text=True)
    assert done.stdout.strip() == "untouched"


def test_unknown_names_are_attribute_errors():
    import hks_jax

    with pytest.raises(AttributeError, match="has no attribute 'fit'"):
        hks_jax.fit  # noqa: B018
