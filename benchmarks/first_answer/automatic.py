"""Times of all solvers among which ``solver="auto"`` chooses: the first call, and later ones.

    python benchmarks/first_answer/automatic.py [--cases 128²/100 16³/50 mesh16384/100 ...] [-o FILE]

Each measurement is a process of its own: a whole `eigenpairs`, assembly included, of the random tensors of the other
benchmarks or of a closed surface; the first call compiles. Single precision is JAX's default, without float64.
"""

import argparse
import json
import subprocess
import sys
import warnings
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import jax
import jax.numpy as jnp
from machine import RESULTS, field, timed_from_cold, write
from versions import parsed

import hks_jax as hj
from hks_jax.eigen.automatic import choose_solver

CASES = ["64²/50", "64²/200", "128²/100", "128²/200", "256²/100", "16³/50", "24³/100", "mesh4096/50", "mesh16384/100"]
PRECISIONS = ["float64", "float32"]


def domain(case: str, precision: str) -> tuple[hj.TensorField | hj.SurfaceMesh, int]:
    """Return the domain of a case, and the number of pairs."""
    if case.startswith("mesh"):
        vertices, k = map(int, case.removeprefix("mesh").split("/"))
        torus = hj.examples.bumpy_torus_mesh(round(vertices**0.5))
        return hj.SurfaceMesh(jnp.asarray(torus.vertices, precision), torus.faces), k
    n, d, k = parsed(case)
    tensors = field(n, d)
    return hj.TensorField(tensors.grid, jnp.asarray(tensors.tensors, precision)), k


def measure(case: str, precision: str, solver: str) -> dict:
    """Return the times of a solver."""
    of, k = domain(case, precision)
    first, later, pairs = timed_from_cold(lambda: hj.eigenpairs(of, k, solver=solver), repeats=2)
    return {
        "case": case,
        "precision": precision,
        "nodes": pairs.pencil.size,
        "k": k,
        "solver": solver,
        "first_call_s": first,
        "seconds": later,
        "worst_residual": float(pairs.residuals.max()),
        "converged": int(pairs.converged.sum()),
        "automatic": choose_solver("auto", pairs.pencil, k).name,
    }


def candidates(case: str) -> list[str]:
    """Return the solvers to try: the dense one, for fewer unknowns than these, is measured in solvers.py."""
    return ["shift-invert", "block-lanczos"] + ([] if case.startswith("mesh") else ["chebyshev-filter"])


def main() -> None:
    """Measure all, print and write the results."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", nargs="+", default=CASES, metavar="N²/K")
    parser.add_argument("--precisions", nargs="+", default=PRECISIONS, choices=PRECISIONS)
    parser.add_argument("--only", nargs=3, help=argparse.SUPPRESS)
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "automatic.json")
    args = parser.parse_args()
    if args.only:
        jax.config.update("jax_enable_x64", args.only[1] == "float64")
        warnings.simplefilter("ignore", hj.AccuracyWarning)
        print(json.dumps(measure(*args.only)))
        return
    rows = []
    for case in args.cases:
        for precision in args.precisions:
            measured = []
            for solver in candidates(case):
                command = [sys.executable, __file__, "--only", case, precision, solver]
                run = subprocess.run(command, check=True, capture_output=True, text=True)
                measured.append(json.loads(run.stdout.splitlines()[-1]))
                print(measured[-1], flush=True)
            for row in measured:
                for time in ("first_call_s", "seconds"):
                    row[f"{time}_ratio"] = row[time] / min(other[time] for other in measured)
                row["chosen"] = row["solver"] == row.pop("automatic")
            rows += measured
            write(args.output, rows)


if __name__ == "__main__":
    main()
