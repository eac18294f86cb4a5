"""The run that is prepared for a GPU, on a CPU with a small volume."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
def test_the_run_agrees_with_closed_forms_and_goes_on_where_it_ended(tmp_path):
    output = tmp_path / "volumes.json"
    command = [sys.executable, str(ROOT / "benchmarks" / "accelerators" / "volumes.py"), "--sizes", "9", "-o", output]
    environment = os.environ | {
        "PYTHONPATH": str(ROOT),
        "JAX_PLATFORMS": "cpu",
        "JAX_COMPILATION_CACHE_DIR": str(ROOT / ".pytest_cache" / "jax"),
    }
    subprocess.run(command, env=environment, check=True, timeout=300)
    first = output.read_text()
    rows = json.loads(first)["rows"]
    pairs, gradient, *_ = rows
    assert {row["what"] for row in rows} == {"eigenpairs", "gradient", "colouring", "eigensolvers"}
    assert pairs["converged"] == pairs["k"] == 8
    assert 0 < pairs["rounds"] < 20
    assert max(pairs["box_error"], pairs["signature_error"]) < 1e-4
    assert 1e-3 < pairs["box_smooth_error"] < 0.1
    assert pairs["worst_residual"] < 1e-2
    assert gradient["scaling_error"] < 1e-4
    subprocess.run([*command, "--minutes", "0"], env=environment, check=True, timeout=60)
    assert output.read_text() == first
