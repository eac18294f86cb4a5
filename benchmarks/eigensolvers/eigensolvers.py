"""The eigensolver for grids and surfaces beside its peers: the same matrices, tolerance and threads, in one run.

    python benchmarks/eigensolvers/eigensolvers.py [--cases 64/100 s65000/100 ...] [--solvers NAME ...] [-o FILE]

64/100 stands for 64² nodes of a grid and 100 pairs, s65000/100 for a closed surface with 65 000 vertices.

Every measurement is a process of its own, so that its peak memory is its own too. Peers that are not installed are left
out, and named: `pip install scikit-sparse lapy`; SLEPc for Python (Debian: python3-slepc4py) may live in an interpreter
of its own, given by --slepc-python.

Timed is the eigensolver alone, from assembled matrices to eigenpairs: factorisation included, compilation apart, the
shortest of five calls, of two where they take longer than ten seconds (SLEPc: of one). LaPy assembles its own
matrices, of a grid on a flat triangulation with as many nodes. The residual is ‖Kφ − λMφ‖/‖Mφ‖/max(λ, λ₁).
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np

HERE = Path(__file__).parent
CASES = ["64/100", "128/100", "256/100", "512/100", "1024/100", "256/200", "256/500"]
TOLERANCE = 1e-8
SHORT = 10.0
"""Seconds up to which a call is repeated more often."""
Pairs = tuple[np.ndarray, np.ndarray]


def surface(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices and faces of a closed surface with bumps, the convex hull of random points on a sphere."""
    from scipy.spatial import ConvexHull

    x = np.random.default_rng(0).standard_normal((n, 3))
    x /= np.linalg.norm(x, axis=1)[:, None]
    return x * (1 + 0.3 * np.sin(4 * x[:, 0]) * np.cos(3 * x[:, 1]))[:, None], ConvexHull(x).simplices


def domain(name: str) -> "hj.TensorField | hj.SurfaceMesh":
    """Return the grid or surface of a case."""
    from machine import field

    import hks_jax as hj

    return hj.SurfaceMesh(*surface(int(name[1:]))) if name.startswith("s") else field(int(name))


def ours(name: str, k: int) -> tuple[Callable[[], tuple], dict]:
    """Block Lanczos of this package, compiled: it also returns the eigenvalue below which all are known."""
    import jax

    import hks_jax as hj

    jax.config.update("jax_enable_x64", True)
    pencil, solver = hj.assemble(domain(name)), hj.BlockLanczos(tolerance=TOLERANCE)
    compiling: list[float] = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda event, seconds, **_: compiling.append(seconds) if event.startswith("/jax/core/compile") else None
    )

    def run() -> tuple:
        return jax.block_until_ready(solver.lowest(pencil, k))

    first, _ = timed(run)
    return run, {"first_call_s": first, "compilation_s": sum(compiling)}


def eigsh(name: str, k: int, package: str | None = None) -> tuple[Callable[[], Pairs], dict]:
    """SciPy's ARPACK in shift-invert mode, as SciPy sets it up, with SuperLU set for symmetric matrices, or CHOLMOD."""
    from scipy.sparse.linalg import LinearOperator, splu
    from scipy.sparse.linalg import eigsh as arpack

    K, M = matrices(name)
    start = np.random.default_rng(0).standard_normal(K.shape[0])

    def inverse() -> LinearOperator | None:
        if package is None:
            return None
        matrix = (K + 0.05 * M).tocsc()
        if package == "CHOLMOD":
            from sksparse.cholmod import cholesky

            return LinearOperator(K.shape, matvec=cholesky(matrix), dtype=float)
        options = {"SymmetricMode": True}
        solve = splu(matrix, "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options).solve
        return LinearOperator(K.shape, matvec=solve, dtype=float)

    def run() -> Pairs:
        values, vectors = arpack(K, k, M, -0.05, OPinv=inverse(), v0=start)
        return values, vectors.T

    return run, {}


def lapy(name: str, k: int) -> tuple[Callable[[], Pairs], dict]:
    """LaPy on the surface, or on a flat triangulation with as many nodes as the grid."""
    from lapy import Solver, TriaMesh

    flat = not name.startswith("s")
    if flat:
        n = int(name)
        x = np.linspace(0, 1, n)
        vertices = np.stack([*map(np.ravel, np.meshgrid(x, x)), np.zeros(n * n)], axis=1)
        corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
        faces = np.concatenate([corner[:, None] + [0, 1, n], corner[:, None] + [1, n + 1, n]])
    else:
        vertices, faces = surface(int(name[1:]))
    solver = Solver(TriaMesh(vertices, faces))

    def run() -> Pairs:
        values, vectors = solver.eigs(k)
        return values, vectors.T

    return run, {"other_matrices": flat}


SOLVERS: dict[str, Callable[[str, int], tuple[Callable[[], tuple], dict]]] = {
    "hks_jax": ours,
    "eigsh": eigsh,
    "eigsh, SuperLU": partial(eigsh, package="SuperLU"),
    "eigsh, CHOLMOD": partial(eigsh, package="CHOLMOD"),
    "LaPy": lapy,
}
SLEPC = {
    "SLEPc, slicing, PETSc Cholesky": ("slicing", "petsc"),
    "SLEPc, slicing, MUMPS": ("slicing", "mumps"),
    "SLEPc, Krylov-Schur, PETSc Cholesky": ("krylov", "petsc"),
    "SLEPc, Krylov-Schur, MUMPS": ("krylov", "mumps"),
}


def matrices(name: str) -> tuple:
    """Return the stiffness and mass of the benchmark's field as SciPy matrices."""
    from scipy.sparse import load_npz

    folder = Path(os.environ["EIGENSOLVERS_MATRICES"])
    return load_npz(folder / f"K{name}.npz"), load_npz(folder / f"M{name}.npz")


def quality(name: str, pairs: Sequence[np.ndarray]) -> dict:
    """Return the worst residual and the eigenvalues."""
    K, M = matrices(name)
    values, vectors = pairs
    order = np.argsort(values)
    values, worst = values[order], 0.0
    for value, vector in zip(values, vectors[order], strict=True):
        image = M @ vector
        scale = np.linalg.norm(image) * max(value, values[1])
        worst = max(worst, float(np.linalg.norm(K @ vector - value * image) / scale))
    return {"worst_residual": worst, "eigenvalues": values.tolist()}


def peak_memory() -> float:
    """Return this process's peak memory in GB (Linux). The number of `resource` is inherited from the parent."""
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) / 1e6


def timed(run: Callable[[], tuple]) -> tuple[float, tuple]:
    """Return how long a call takes, and its result: without JAX, whose memory would count as that of the peers."""
    start = time.perf_counter()
    result = run()
    return time.perf_counter() - start, result


def measure_here(solver: str, name: str, k: int, compiling: bool) -> None:
    """Run one solver in this process and print its cost as JSON; or the cost of its compilation alone."""
    if compiling:
        import jax

        jax.config.update("jax_cpu_enable_async_dispatch", False)
    run, more = SOLVERS[solver](name, k)
    if compiling:
        print(json.dumps(more))
        return
    seconds, result = timed(run)
    for _ in range(4 if seconds < SHORT else 1):
        del result  # not to hold two at once
        again, result = timed(run)
        seconds = min(seconds, again)
    *pairs, complete_below = map(np.asarray, result) if len(result) == 3 else (*result, None)
    found = {"seconds": seconds, **more, "peak_GB": peak_memory()}
    if complete_below is not None:
        found["complete_below"] = float(complete_below)
    found |= {"eigenvalues": pairs[0].tolist()} if found.pop("other_matrices", False) else quality(name, pairs)
    print(json.dumps(found))


def measure(solver: str, name: str, k: int, reference: list[float], slepc_python: str, limit: float) -> dict | str:
    """Run one solver in a process of its own; return its cost, or why it did not run."""
    if solver in SLEPC:
        if not reference:
            return "needs the interval's end, from another solver"
        method, package = SLEPC[solver]
        end = (reference[k - 1] + reference[k]) / 2
        command = [slepc_python, str(HERE / "slepc.py"), method, package, name, str(k), repr(end), str(TOLERANCE)]
    else:
        command = [sys.executable, __file__, "--here", solver, name, str(k)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=limit)
    except subprocess.TimeoutExpired:
        return f"more than {limit:.0f} s"
    if done.returncode != 0:
        return (done.stderr.strip().splitlines() or ["failed"])[-1]
    found = json.loads(done.stdout.splitlines()[-1])
    if "compilation_s" in found:
        # In the first call one computation is compiled while another runs on the same cores: again one by one.
        alone = subprocess.run([*command, "compiling"], capture_output=True, text=True, check=True)
        found["compilation_s"] = json.loads(alone.stdout.splitlines()[-1])["compilation_s"]
    return found


def main() -> None:
    """Measure every case, print a table, write the results."""
    if sys.argv[1:2] == ["--here"]:
        measure_here(sys.argv[2], sys.argv[3], int(sys.argv[4]), "compiling" in sys.argv)
        return
    import jax
    from machine import RESULTS, write
    from scipy.sparse import save_npz

    import hks_jax as hj

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", nargs="+", default=CASES, metavar="N/K", help="N² nodes (sN: N vertices), K pairs")
    parser.add_argument("--solvers", nargs="+", default=[*SOLVERS, *SLEPC], metavar="NAME")
    parser.add_argument("--slepc-python", default=sys.executable, help="an interpreter that can import slepc4py")
    parser.add_argument("--limit", type=float, default=900, help="seconds for each measurement")
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "eigensolvers.json")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    rows: list[dict] = []
    with tempfile.TemporaryDirectory() as folder:
        os.environ["EIGENSOLVERS_MATRICES"] = folder
        for case in arguments.cases:
            where, _, pairs = case.partition("/")
            k, nodes = int(pairs), int(where[1:]) if where.startswith("s") else int(where) ** 2
            if not (Path(folder) / f"K{where}.npz").exists():
                pencil = hj.assemble(domain(where))
                for letter, matrix in (("K", pencil.stiffness.to_scipy()), ("M", pencil.mass.to_scipy())):
                    save_npz(Path(folder) / f"{letter}{where}.npz", matrix)
                    matrix = matrix.tocsr()
                    arrays = {"indptr": matrix.indptr, "indices": matrix.indices, "data": matrix.data}
                    np.savez(Path(folder) / f"{letter}{where}_csr.npz", **arrays)
            reference: list[float] = []
            print(f"{where}: {nodes} nodes, {k} pairs", flush=True)
            for solver in arguments.solvers:
                more = 1 if solver == "hks_jax" else 0  # one more, for the end of the interval that slicing needs
                found = measure(solver, where, k + more, reference, arguments.slepc_python, arguments.limit)
                if isinstance(found, str):
                    print(f"  {solver:38s} {found}", flush=True)
                    rows.append({"nodes": nodes, "k": k, "solver": solver, "not_run": found})
                    continue
                values = found.pop("eigenvalues")
                reference = reference or values
                if solver != "LaPy":
                    scale = np.maximum(reference[:k], reference[1])
                    found["eigenvalue_difference"] = float(
                        np.max(np.abs(np.subtract(values[:k], reference[:k])) / scale)
                    )
                rows.append({"nodes": nodes, "k": k, "solver": solver, **found})
                shown = " ".join(f"{key} {value:.3g}" for key, value in found.items())
                print(f"  {solver:38s} {shown}", flush=True)
            write(arguments.output, rows, tolerance=TOLERANCE)


if __name__ == "__main__":
    main()
