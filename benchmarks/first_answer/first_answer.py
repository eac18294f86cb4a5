"""The first answer: seconds from the start of a process to its first signature, imports and compilation included.

    python benchmarks/first_answer/first_answer.py [--cases plane-64 …] [-o FILE]

Every first call runs in a process of its own: once without a cache of programs, and once with the cache that the run
before it filled. The calls that follow in the same process are the same again, one on a grid of another spacing, one
with a mask and one with another mask. Beside them stand SciPy (`eigsh` about a shift, of matrices in a file),
scikit-fem with SciPy (assembly included), and on surfaces LaPy where it is installed.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

START = time.perf_counter()
CASES = {
    "plane-32": (2, 32, 50),
    "plane-64": (2, 64, 100),
    "plane-128": (2, 128, 200),
    "plane-256": (2, 256, 100),
    "space-16": (3, 16, 50),
    "surface-4000": (0, 4_000, 100),
    "surface-40000": (0, 40_000, 100),
}
"""Dimension (0 for a surface), nodes along an axis or in all, and k."""
WAYS = ("hks_jax", "hks_jax gradient", "SciPy", "scikit-fem", "LaPy")
TIMES = (0.01, 0.1)


def tensors(d: int, n: int) -> tuple[Any, float]:
    """Return smooth anisotropic tensors on n^d nodes of the unit square or cube, and the spacing."""
    import numpy as np

    h = 1 / (n - 1)
    x = np.stack(np.meshgrid(*[np.arange(n) * h] * d, indexing="ij"), -1)
    stretch = 1 + 0.5 * np.sin(3 * x[..., 0]) * np.cos(2 * x[..., 1])
    field = np.zeros((*x.shape[:-1], d, d))
    field[...] = np.eye(d)
    field[..., 0, 0], field[..., 1, 1] = stretch, 1 / stretch
    field[..., 0, 1] = field[..., 1, 0] = 0.2
    return field, h


def surface(n: int) -> tuple[Any, Any]:
    """Return vertices and triangles of a bumpy torus of about n vertices."""
    import numpy as np

    rows = round((n / 2) ** 0.5)
    u, v = np.meshgrid(np.arange(2 * rows) * np.pi / rows, np.arange(rows) * 2 * np.pi / rows, indexing="ij")
    r = 0.4 + 0.05 * np.cos(3 * u) * np.sin(2 * v)
    points = np.stack([(1 + r * np.cos(v)) * np.cos(u), (1 + r * np.cos(v)) * np.sin(u), r * np.sin(v)], -1)
    i = np.arange(points.shape[0] * rows).reshape(-1, rows)
    right, up, both = np.roll(i, -1, 0), np.roll(i, -1, 1), np.roll(i, (-1, -1), (0, 1))
    return points.reshape(-1, 3), np.concatenate(
        [np.stack([i, right, both], -1).reshape(-1, 3), np.stack([i, both, up], -1).reshape(-1, 3)]
    )


def ours(case: str, gradient: bool) -> dict[str, float]:
    """Time the first call, the same again, and calls on another mask and another spacing."""
    import warnings

    import jax
    import jax.numpy as jnp
    import numpy as np

    import hks_jax as hj

    warnings.simplefilter("ignore", hj.AccuracyWarning)
    jax.config.update("jax_enable_x64", True)
    d, n, k = CASES[case]

    def run(make: Callable[[Any], Any], x: Any) -> float:
        def total(x: Any) -> Any:
            return jnp.nansum(hj.hks(hj.eigenpairs(make(x), k), TIMES))

        begin = time.perf_counter()
        jax.block_until_ready(jax.value_and_grad(total)(x) if gradient else total(x))
        return time.perf_counter() - begin

    if d == 0:
        points, triangles = surface(n)
        on_mesh, values = lambda x: hj.SurfaceMesh(x, triangles), jnp.asarray(points)
        run(on_mesh, values)
        first = time.perf_counter() - START
        return {"first_s": first, "later_s": run(on_mesh, values)}
    field, h = tensors(d, n)
    x = np.stack(np.meshgrid(*[np.linspace(-1, 1, n)] * d, indexing="ij"), -1)
    grids = {
        "first_s": hj.Grid((n,) * d, h),
        "later_s": hj.Grid((n,) * d, h),
        "another_spacing_s": hj.Grid((n,) * d, 1.3 * h),
        "mask_s": hj.Grid((n,) * d, h, mask=np.linalg.norm(x, axis=-1) < 0.9),
        "another_mask_s": hj.Grid((n,) * d, h, mask=np.linalg.norm(x, axis=-1) < 0.8),
    }
    found = {}
    for name, grid in grids.items():
        seconds = run(lambda t, grid=grid: hj.TensorField(grid, t), jnp.asarray(field))
        found[name] = time.perf_counter() - START if name == "first_s" else seconds
    return found


def signature(K: Any, M: Any, k: int) -> Any:
    """Return the signature by SciPy's `eigsh` about a shift below the spectrum."""
    import numpy as np
    from scipy.sparse.linalg import eigsh

    values, vectors = eigsh(K, k, M, -1.0)
    return np.exp(-np.outer(TIMES, values)) @ (vectors**2).T


def by_scipy(case: str, folder: Path) -> dict[str, float]:
    """Time SciPy on matrices in a file."""
    import scipy.sparse as sp

    signature(sp.load_npz(folder / f"{case}-K.npz"), sp.load_npz(folder / f"{case}-M.npz"), CASES[case][2])
    return {"first_s": time.perf_counter() - START}


def by_skfem(case: str) -> dict[str, float]:
    """Time scikit-fem's assembly and SciPy."""
    import numpy as np
    import skfem

    d, n, k = CASES[case]
    field, h = tensors(d, n)
    axis = np.linspace(0, 1, n)
    mesh = (skfem.MeshQuad if d == 2 else skfem.MeshHex).init_tensor(*[axis] * d)
    basis = skfem.Basis(mesh, (skfem.ElementQuad1 if d == 2 else skfem.ElementHex1)(), intorder=2)
    nodes = tuple(np.rint(mesh.p / h).astype(int))
    at = {(i, j): basis.interpolate(field[nodes][:, i, j]) for i in range(d) for j in range(d)}
    metric = np.array([[at[i, j] for j in range(d)] for i in range(d)])
    metric = np.moveaxis(metric, (0, 1), (-2, -1))
    root, inverse = np.sqrt(np.linalg.det(metric)), np.linalg.inv(metric)

    @skfem.BilinearForm
    def stiffness(u: Any, v: Any, w: Any) -> Any:
        return root * np.einsum("eqij,ieq,jeq->eq", inverse, u.grad, v.grad)

    @skfem.BilinearForm
    def mass(u: Any, v: Any, w: Any) -> Any:
        return root * u * v

    signature(stiffness.assemble(basis).tocsc(), mass.assemble(basis).tocsc(), k)
    return {"first_s": time.perf_counter() - START}


def by_lapy(case: str) -> dict[str, float]:
    """Time LaPy, on a surface."""
    import numpy as np
    from lapy import Solver, TriaMesh

    _, n, k = CASES[case]
    values, vectors = Solver(TriaMesh(*surface(n))).eigs(k)
    np.exp(-np.outer(TIMES, values)) @ (vectors**2).T
    return {"first_s": time.perf_counter() - START}


def child(case: str, way: str, folder: Path) -> None:
    """Run one library on one case, and print its timings."""
    if way.startswith("hks_jax"):
        found = ours(case, way.endswith("gradient"))
    else:
        found = {"SciPy": lambda: by_scipy(case, folder), "scikit-fem": lambda: by_skfem(case)}.get(
            way, lambda: by_lapy(case)
        )()
    print(json.dumps(found))


def save_matrices(case: str, folder: Path) -> None:
    """Write the matrices of a case for SciPy."""
    import jax
    import scipy.sparse as sp

    import hks_jax as hj

    jax.config.update("jax_enable_x64", True)
    d, n, _ = CASES[case]
    if d:
        field, h = tensors(d, n)
        pencil = hj.assemble(hj.TensorField(hj.Grid((n,) * d, h), field))
    else:
        pencil = hj.assemble(hj.SurfaceMesh(*surface(n)))
    for name, matrix in (("K", pencil.stiffness), ("M", pencil.mass)):
        sp.save_npz(folder / f"{case}-{name}.npz", matrix.to_scipy().tocsc())


def possible(case: str, way: str) -> bool:
    """Return whether a way is for the case: scikit-fem has grids here, LaPy surfaces."""
    on_surface = CASES[case][0] == 0
    return {"scikit-fem": not on_surface, "LaPy": on_surface}.get(way, True)


def measured(case: str, way: str, folder: Path, cache: Path | None) -> dict[str, float] | None:
    """Run a process; None where the library is not installed."""
    environment = os.environ | {"JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)  # installed packages have bytecode
    if cache is not None:
        environment["JAX_COMPILATION_CACHE_DIR"] = str(cache)
    command = [sys.executable, __file__, "--child", case, way, str(folder)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    if done.returncode:
        print(f"{case}, {way}: {done.stderr.strip().splitlines()[-1]}")
        return None
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    """Measure all cases and write the rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=list(WAYS))
    parser.add_argument("--child", nargs=3, help=argparse.SUPPRESS)
    parser.add_argument("-o", "--output", type=Path)
    args = parser.parse_args()
    if args.child:
        case, way, where = args.child
        child(case, way, Path(where))
        return
    from machine import RESULTS, write

    rows = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for case in args.cases:
            save_matrices(case, folder)
            for way in args.ways:
                if not possible(case, way):
                    continue
                row = {"case": case, "k": CASES[case][2], "way": way}
                ours = way.startswith("hks_jax")
                cache = folder / f"{case} {way}" if ours else None
                found = measured(case, way, folder, cache)
                if found is None:
                    continue
                row |= found
                if ours and (again := measured(case, way, folder, cache)):
                    row["cached_s"] = again["first_s"]
                rows.append(row)
                print({name: round(x, 2) if isinstance(x, float) else x for name, x in row.items()})
    write(args.output or RESULTS / "first_answer.json", rows)


if __name__ == "__main__":
    main()
