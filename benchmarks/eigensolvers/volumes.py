"""Eigensolvers on volumes: the matrix-free one beside those that factorise, the same matrices, one run.

    python benchmarks/eigensolvers/volumes.py [--cases 32/200 ...] [--solvers NAME ...] [--limit SECONDS] [-o FILE]

The file filter.json is that of ``--solvers chebyshev-filter`` with the cases 32/200 to 128/200.

Every measurement is a process of its own, so that its peak memory is its own too; one that takes longer than the limit,
or more memory than there is, is reported as such. Timed is the eigensolver alone, from assembled matrices to
eigenpairs, compilation apart (the second call, where the first takes under four minutes). The peak of memory is that of
the first call, because the second one begins beside its result. The residual is
‖Kφ − λMφ‖/‖Mφ‖/max(λ, λ₁).
"""

import argparse
import json
import resource
import subprocess
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np

CASES = ["32/200", "48/200", "64/200", "96/200"]
TOLERANCE = 1e-8
SOLVERS = ("chebyshev-filter", "block-lanczos", "eigsh, SuperLU")


def measure_here(name: str, n: int, k: int, memory: float) -> None:
    """Run one solver in this process, and print its cost as JSON."""
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)
    from eigensolvers import peak_memory
    from machine import field, relative_residuals, timed_once

    import hks_jax as hj

    pencil = hj.assemble(field(n, d=3))
    if name == "eigsh, SuperLU":
        resource.setrlimit(resource.RLIMIT_AS, (int(memory * 1e9),) * 2)
        values, vectors, found = eigsh(pencil.stiffness.to_scipy(), pencil.mass.to_scipy(), k)
        found["peak_GB"] = peak_memory()
    else:
        solver = {"chebyshev-filter": hj.ChebyshevFilter, "block-lanczos": hj.BlockLanczos}[name](tolerance=TOLERANCE)
        first, (values, vectors, _) = timed_once(solver.lowest, pencil, k)
        found = {"seconds": first, "first_call_s": first, "peak_GB": peak_memory()}
        if first < 240:
            found["seconds"], (values, vectors, _) = timed_once(solver.lowest, pencil, k)
    worst = float(relative_residuals(pencil, jnp.asarray(values), jnp.asarray(vectors)).max())
    print(json.dumps(found | {"worst_residual": worst, "eigenvalues": np.asarray(values).tolist()}))


def eigsh(K, M, k: int) -> tuple[np.ndarray, np.ndarray, dict]:
    """SciPy's ARPACK in shift-invert mode with SuperLU."""
    from scipy.sparse.linalg import LinearOperator, splu
    from scipy.sparse.linalg import eigsh as arpack

    start = time.perf_counter()
    factor = splu((K + 0.05 * M).tocsc(), "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    print(f"SuperLU: {factor.nnz * 12e-9:.1f} GB in {time.perf_counter() - start:.0f} s", file=sys.stderr, flush=True)
    inverse = LinearOperator(K.shape, matvec=factor.solve, dtype=float)
    start_vector = np.random.default_rng(0).standard_normal(K.shape[0])
    values, vectors = arpack(K, k, M, -0.05, OPinv=inverse, v0=start_vector)
    return values, vectors.T, {"seconds": time.perf_counter() - start, "factor_GB": factor.nnz * 12e-9}


def measure(name: str, n: int, k: int, limit: float, memory: float) -> dict:
    """Run one solver in a process of its own; return its cost, or why it did not run."""
    command = [sys.executable, __file__, "--here", name, str(n), str(k), str(memory)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=limit)
    except subprocess.TimeoutExpired as stopped:
        said = (stopped.stderr or b"").decode().strip().splitlines()
        return {"not_run": f"more than {limit:g} s" + (f"; {said[-1]}" if said else "")}
    if done.returncode:
        said = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
        return {"not_run": said[-1]}
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    """Measure, print a table, and write the result file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", nargs="+", default=CASES, metavar="N/K", help="N³ nodes, K pairs")
    parser.add_argument("--solvers", nargs="+", choices=SOLVERS, default=SOLVERS)
    parser.add_argument("--limit", type=float, default=1200.0, help="seconds for one measurement")
    parser.add_argument("--memory", type=float, default=12.0, help="GB that eigsh may take")
    parser.add_argument("-o", "--output", type=Path)
    parser.add_argument("--here", nargs=4, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.here:
        name, n, k, memory = args.here
        measure_here(name, int(n), int(k), float(memory))
        return
    from machine import RESULTS, write

    rows = []
    for case in args.cases:
        n, k = map(int, case.split("/"))
        reference = None
        for name in args.solvers:
            found = measure(name, n, k, args.limit, args.memory)
            row = {"nodes": n**3, "k": k, "solver": name} | found
            values = row.pop("eigenvalues", None)
            if values is not None:
                reference = values if reference is None else reference
                pairs = zip(values, reference, strict=True)
                row["largest_difference"] = max(abs(a - b) / max(b, reference[1]) for a, b in pairs)
            rows.append(row)
            seconds, peak = row.get("seconds", float("nan")), row.get("peak_GB", float("nan"))
            print(f"{n}³ {k:4d} {name:20s} {seconds:8.1f} s {peak:6.1f} GB {row.get('not_run', '')}", flush=True)
    write(args.output or RESULTS / "volumes.json", rows, tolerance=TOLERANCE)


if __name__ == "__main__":
    main()
