"""Where does the sparse solver overtake the dense one? The measurement behind ``solver="auto"``.

    python benchmarks/first_answer/solvers.py [-o benchmarks/results/solvers.json]

Both solvers get the same matrices in the same process. Each case is compiled, then timed, best of three;
the ratio is compared. The result file holds times, the largest relative difference of the eigenvalues, and the machine.
"""

import argparse
import sys
import warnings
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import jax
import numpy as np
from machine import RESULTS, field, timed, write

import hks_jax as hj

CASES = [(n, k) for n in (16, 24, 32, 40, 48) for k in (20, 100, 300) if 4 * k <= 3 * n * n]


def main() -> None:
    """Measure, print a table, and write the result file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "solvers.json")
    output = parser.parse_args().output
    jax.config.update("jax_enable_x64", True)
    warnings.simplefilter("ignore", hj.AccuracyWarning)
    rows = []
    print("   n²    k   dense s  sparse s  dense/sparse  difference")
    for n, k in CASES:
        pencil = hj.assemble(field(n))
        dense, reference = timed(lambda p, k=k: hj.eigenpairs(p, k, solver="dense"), pencil)
        sparse, pairs = timed(lambda p, k=k: hj.eigenpairs(p, k, solver="shift-invert"), pencil)
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
    write(output, rows)


if __name__ == "__main__":
    main()
