"""Where does the sparse solver overtake the dense one? The measurement behind ``solver="auto"``.

    python benchmarks/solvers.py [-o benchmarks/results/solvers.json]

Both solvers get the same matrices in the same process. Each case is compiled, then timed, best of three; what is
compared is the ratio. The result file holds times, the largest relative difference of the eigenvalues, and the machine.
"""

import argparse
import json
import os
import platform
import time
import warnings
from pathlib import Path

import jax
import numpy as np

import hks_jax as hj

CASES = [(n, k) for n in (16, 24, 32, 40, 48) for k in (20, 100, 300) if 4 * k <= 3 * n * n]


def field(n: int) -> hj.TensorField:
    """Anisotropic tensors of eigenvalues 1 … 4 and random directions, n² nodes."""
    rng = np.random.default_rng(n)
    frames = np.linalg.qr(rng.standard_normal((n, n, 2, 2)))[0]
    values = rng.uniform(1, 4, (n, n, 2))
    return hj.TensorField(hj.Grid((n, n), 1 / (n - 1)), np.einsum("...ia,...a,...ja->...ij", frames, values, frames))


def best_of(repeats: int, solver: str, pencil: hj.Pencil, k: int) -> tuple[float, hj.Eigenpairs]:
    """Return the shortest time after a warm-up, and the pairs."""
    pairs = jax.block_until_ready(hj.eigenpairs(pencil, k, solver=solver))
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(hj.eigenpairs(pencil, k, solver=solver))
        times.append(time.perf_counter() - start)
    return min(times), pairs


def main() -> None:
    """Measure, print a table, and write the result file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, default=Path(__file__).parent / "results" / "solvers.json")
    output = parser.parse_args().output
    jax.config.update("jax_enable_x64", True)
    warnings.simplefilter("ignore", hj.AccuracyWarning)
    rows = []
    print("   n²    k   dense s  sparse s  dense/sparse  difference")
    for n, k in CASES:
        pencil = hj.assemble(field(n))
        dense, reference = best_of(3, "dense", pencil, k)
        sparse, pairs = best_of(3, "shift-invert", pencil, k)
        scale = np.maximum(reference.eigenvalues, reference.eigenvalues[1])
        difference = float(np.max(np.abs(pairs.eigenvalues - reference.eigenvalues) / scale))
        rows.append(
            {
                "unknowns": n * n,
                "k": k,
                "dense_s": dense,
                "shift_invert_s": sparse,
                "ratio": dense / sparse,
                "eigenvalue_difference": difference,
                "worst_residual": float(max(reference.residuals.max(), pairs.residuals.max())),
            }
        )
        print(f"{n * n:5d} {k:4d} {dense:9.3f} {sparse:9.3f} {dense / sparse:13.2f} {difference:11.1e}")
    machine = {"processor": platform.machine(), "cores": os.cpu_count(), "device": jax.devices()[0].device_kind}
    versions = {"python": platform.python_version(), "jax": jax.__version__, "hks_jax": hj.__version__}
    output.parent.mkdir(parents=True, exist_ok=True)
    output.write_text(json.dumps({"machine": machine, "versions": versions, "rows": rows}, indent=2) + "\n")
    print(f"written to {output}")


if __name__ == "__main__":
    main()
