"""Importing the package must leave JAX, and everything else, as it was."""

import subprocess
import sys

import pytest

CHECK = """
import os, sys, warnings
os.environ["JAX_PLATFORMS"] = "no_such_platform"  # the first computation would raise
warnings.simplefilter("error")
import jax
before = dict(jax.config.values)
import hks_jax
hks_jax.hks, hks_jax.Grid((4, 5), 0.5, mask=None)
after = dict(jax.config.values)
assert before == after, {k: (before.get(k), v) for k, v in after.items() if before.get(k) != v}
warnings.simplefilter("default")

def absent(*names):
    assert not set(names) & set(sys.modules), [name for name in names if name in sys.modules]

absent("matplotlib", "nibabel", "dipy")
assert hks_jax.examples.__name__ == "hks_jax.domain.examples"
import hks_jax.cli
hks_jax.cli.build_parser()
absent("matplotlib", "optimistix")
assert hks_jax.plot.__name__ == "hks_jax.plot"
import hks_jax.plot
absent("matplotlib.pyplot")
try:
    jax.numpy.zeros(3)
except RuntimeError:
    print("untouched")
"""


def test_import_changes_nothing_and_loads_and_starts_nothing_before_it_is_needed():
    done = subprocess.run([sys.executable, "-c", CHECK], check=False, capture_output=True, text=True)
    assert (done.stdout.strip(), done.returncode) == ("untouched", 0), done.stderr


def test_unknown_names_are_attribute_errors():
    import hks_jax

    with pytest.raises(AttributeError, match="has no attribute 'fit'"):
        hks_jax.fit  # noqa: B018
