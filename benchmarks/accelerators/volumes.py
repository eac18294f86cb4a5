"""Volumes of up to 256³ nodes on a GPU, in one run of nine minutes: time, memory, rounds and errors, in float32.

    python benchmarks/accelerators/volumes.py [--cases 96/200 ...] [--minutes 9] [-o FILE]
    python benchmarks/accelerators/volumes.py --sizes 16 24 -o FILE     # tries itself on a CPU, with few eigenpairs
    python benchmarks/accelerators/volumes.py --on-cpu 256/50           # one case in 23 GB of memory: volumes_cpu.json

Each case computes the eigenpairs of a flat box, whose discrete eigenvalues and signature have closed forms, and then of
a smooth random field, whose residuals are computed again in float64. The box is the first call and includes the
compilation; the random field runs compiled programs. The parts after the cases are the gradient of a loss, signatures
without a spectrum, and other eigensolvers on the same matrix. The result file is written after each part, and another
call goes on with the parts that are not in the file. A case that would not end in time, by the speed of the case before
it, is left out. Compiled programs are kept in the folder that JAX_COMPILATION_CACHE_DIR names.
"""

import argparse
import itertools
import json
import math
import os
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parents[1] / "eigensolvers")]

os.environ.setdefault("XLA_PYTHON_CLIENT_MEM_FRACTION", "0.95")  # before JAX starts

import accelerator  # noqa: E402
import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from eigensolvers import peak_memory  # noqa: E402
from machine import RESULTS, relative_residuals, timed_once, write  # noqa: E402

import hks_jax as hj  # noqa: E402
from hks_jax.fem.nodal import nodal_pencil  # noqa: E402

CASES = ("96/200", "128/200", "128/500", "192/200", "256/100", "256/200", "256/500")
LENGTHS = np.array([1.0, 1.1, 1.23])
"""The lengths of the flat box, for which no low eigenvalue is multiple."""
REST = 90.0
"""Seconds that the cases leave to the other parts."""


def grid(n: int) -> hj.Grid:
    """Return n³ nodes on the unit cube."""
    return hj.Grid((n,) * 3, 1 / (n - 1))


@partial(jax.jit, static_argnums=0)
def assembled(n: int, tensors: jax.Array) -> Any:
    """Return the pencil of tensors whose values are not checked."""
    return hj.assemble(hj.TensorField(grid(n), tensors))


@partial(jax.jit, static_argnums=0)
def box(n: int) -> jax.Array:
    """Return the metric of the flat box."""
    return jnp.broadcast_to(jnp.diag(jnp.asarray(LENGTHS**2, jnp.float32)), (n, n, n, 3, 3))


@partial(jax.jit, static_argnums=0)
def random_field(n: int) -> jax.Array:
    """Return a smooth random metric FᵀF with eigenvalues between 1/4 and 9/4: F differs from I by at most 1/2."""
    keys = jax.random.split(jax.random.key(0))
    waves = jax.random.randint(keys[0], (8, 3), -2, 3).astype(jnp.float32)
    amplitudes = jax.random.normal(keys[1], (8, 3, 3))
    amplitudes /= 2 * jnp.sum(jnp.linalg.norm(amplitudes, axis=(1, 2)))
    x = jnp.stack(jnp.meshgrid(*[jnp.linspace(0, 2 * jnp.pi, n)] * 3, indexing="ij"), -1)
    factor = jnp.eye(3) + jnp.einsum("...w,wab->...ab", jnp.sin(x @ waves.T + jnp.arange(8.0)), amplitudes)
    return jnp.einsum("...ca,...cb->...ab", factor, factor)


def closed_form(n: int, k: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the k lowest eigenvalues of the box's matrices and of the box, and the modes' numbers along each axis."""
    i = np.arange(min(n, 2 * math.ceil(k ** (1 / 2)) + 4))
    cosine = np.cos(np.pi * i / (n - 1))
    of_axis = 6 * (n - 1) ** 2 * (1 - cosine) / (2 + cosine)
    modes = np.array(list(itertools.product(i, repeat=3)))
    discrete, smooth = ((values[modes] / LENGTHS**2).sum(1) for values in (of_axis, (np.pi * i) ** 2))
    lowest = np.argsort(discrete)[:k]
    return discrete[lowest], smooth[lowest], modes[lowest]


def box_signature(n: int, k: int, times: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Return Σ e^(−λt) φ(x)² of the k lowest modes of the box's matrices at nodes (m, 3)."""
    values, _, modes = closed_form(n, k)
    # The mode cos(iπx) has the squared norm (2 + cos(iπh))/6 in the mass of an interval of length 1.
    sizes = np.where(modes == 0, 1, 6 / (2 + np.cos(np.pi * modes / (n - 1))))
    squares = sizes * np.cos(np.pi * modes * nodes[:, None] / (n - 1)) ** 2
    return np.exp(-times[:, None] * values) @ squares.prod(2).T / LENGTHS.prod()


def rounds_of(told: list[str]) -> int:
    """Return the number of rounds on the finest grid, from the texts of progress."""
    return max((int(text.split(":")[0].split()[1]) for text in told if text.startswith("round")), default=0)


def peak_GB() -> float:
    """Return the peak memory of the device so far, or of this process if the device does not know."""
    known = jax.devices()[0].memory_stats() or {}
    return known["peak_bytes_in_use"] / 1e9 if "peak_bytes_in_use" in known else peak_memory()


def solve(
    n: int, k: int, metric: Callable[[int], jax.Array], solver: Any = "chebyshev-filter", show: Any = lambda text: None
) -> tuple[float, float, hj.Eigenpairs, int]:
    """Return the seconds of assembly and eigenpairs, the eigenpairs, and the rounds on the finest grid."""
    told: list[str] = []

    def tell(text: str) -> None:
        told.append(text)
        show(text)

    of_assembly, pencil = timed_once(assembled, n, metric(n))
    return of_assembly, *timed_once(partial(hj.eigenpairs, pencil, k, solver=solver, progress=tell)), rounds_of(told)


def measure(n: int, k: int) -> dict:
    """Return the row of a case."""
    times = np.geomspace(4, 400, 8) / closed_form(n, k)[0][-1]
    row: dict[str, Any] = {}

    _, row["first_call_s"], pairs, row["box_rounds"] = solve(n, k, box)
    discrete, smooth, _ = closed_form(n, k)
    values = np.asarray(pairs.eigenvalues, float)
    for name, exact in (("box_error", discrete), ("box_smooth_error", smooth)):
        row[name] = float(np.max(np.abs(values - exact)[1:] / exact[1:]))
    signature = hj.hks(pairs, times)
    nodes = np.random.default_rng(0).integers(0, n, (50, 3))
    known = box_signature(n, k, times, nodes)
    row["signature_error"] = float(np.max(np.abs(np.asarray(signature)[:, *nodes.T] / known - 1)))
    del pairs, signature
    row["assembly_s"], row["seconds"], pairs, row["rounds"] = solve(n, k, random_field)
    row["signature_s"], _ = timed_once(hj.hks, pairs, times)
    row["converged"] = int(pairs.converged.sum())
    row["residuals_s"], residuals = timed_once(relative_residuals, pairs.pencil, pairs.eigenvalues, pairs.vectors)
    return row | {"worst_residual": float(residuals.max()), "peak_GB": peak_GB()}


def on_cpu(n: int, k: int) -> dict:
    """Return the row of the random field alone, with few vectors in a block, as a CPU with little memory needs it.

    The time of the eigenpairs includes the compilation. The residuals are those of the result, in single precision.
    """
    solver = hj.ChebyshevFilter(tolerance=1e-4, block=8)
    of_assembly, seconds, pairs, rounds = solve(n, k, random_field, solver, partial(print, flush=True))
    values = np.asarray(pairs.eigenvalues, float)
    row = {"assembly_s": of_assembly, "seconds": seconds, "rounds": rounds, "eigenvalues": values.tolist()}
    row["signature_s"], _ = timed_once(hj.hks, pairs, np.geomspace(4, 400, 8) / values[-1])
    worst = {"worst_residual": float(pairs.residuals.max()), "largest_rounding": float(pairs.rounding.max())}
    row |= worst | {"converged": int(pairs.converged.sum()), "peak_GB": peak_GB()}
    del pairs
    return row | {"largest_error": error_of(values, n, k)}


def error_of(found: np.ndarray, n: int, k: int) -> float:
    """Return the largest relative error of eigenvalues of the random field, against double precision on coarser grids.

    The errors of the finite elements are a₂h² + a₄h⁴ + …, so that three grids determine the eigenvalues on n³ nodes.
    """
    values, sides = [], (48, 64, 80)
    for side in sides:
        tensors = np.asarray(random_field(side))
        with jax.enable_x64(True):
            field = hj.TensorField(grid(side), tensors.astype(float))
            values.append(np.asarray(hj.eigenpairs(field, k, solver="chebyshev-filter").eigenvalues))

    def powers(sides: Any) -> np.ndarray:
        return (1 / (np.asarray(sides, float)[:, None] - 1)) ** np.array([0, 2, 4])

    expected = (powers([n]) @ np.linalg.solve(powers(sides), np.array(values)))[0]
    return float(np.max(np.abs(found[1:] / expected[1:] - 1)))


def gradient(n: int, k: int) -> dict:
    """Return the row of the gradient of a loss.

    If the metric grows by a factor s, the eigenvalues become λ/s and the signature h(t) becomes s^(−3/2) h(t/s). So the
    derivative of Σ log h(t) by s at s = 1 is the sum of −3/2 − t h'(t)/h(t).
    """
    tensors, times = random_field(n), jnp.array([0.05, 0.2])

    def loss(tensors: jax.Array) -> tuple[jax.Array, hj.Eigenpairs]:
        pairs = hj.eigenpairs(hj.TensorField(grid(n), tensors), k, solver="chebyshev-filter")
        return jnp.sum(jnp.log(hj.hks(pairs, times))), pairs

    run = jax.value_and_grad(loss, has_aux=True)
    first, _ = timed_once(run, tensors)
    seconds, ((_, pairs), found) = timed_once(run, tensors)
    signature, slope = jax.jvp(partial(hj.hks, pairs), (times,), (times,))
    exact = float(np.sum(-1.5 - np.asarray(slope, float) / np.asarray(signature, float)))
    error = abs(float(np.sum(np.asarray(found, float) * np.asarray(tensors, float))) / exact - 1)
    costs = {"first_call_s": first, "seconds": seconds, "scaling_error": error, "peak_GB": peak_GB()}
    return costs


def others(n: int, k: int) -> Iterator[dict]:
    """Yield rows of several eigensolvers on the lumped matrices of the flat box, and their times relative to ours."""
    told: list[str] = []
    pencil = jax.jit(lambda T: hj.assemble(hj.TensorField(grid(n), T), mass="lumped"))(box(n))
    run = partial(hj.eigenpairs, pencil, k, solver=hj.ChebyshevFilter(tolerance=1e-3), progress=told.append)
    first, _ = timed_once(run)
    ours, pairs = timed_once(run)
    yield {"way": "Chebyshev filter", "first_call_s": first, "seconds": ours, "error": 0.0}
    nodal = nodal_pencil(pencil)
    root, stiffness = jnp.sqrt(nodal.lumped)[..., None], nodal.stiffness.of_columns()
    top = 1.01 * float(jnp.max(jnp.sum(jnp.abs(nodal.stiffness.coefficients), 0) / nodal.lumped))

    @jax.jit
    def product(x: jax.Array) -> jax.Array:  # top − D^(−½) K D^(−½), whose largest eigenvalues are wanted
        columns = x.reshape(*nodal.shape, -1)
        return top * x - (stiffness(columns / root) / root).reshape(x.shape)

    def by_lobpcg() -> Any:
        from jax.experimental.sparse.linalg import lobpcg_standard

        start = jax.random.normal(jax.random.key(0), (n**3, k), jnp.float32)
        return top - lobpcg_standard(product, start, m=500)[0]

    def by_cupy(name: str) -> Any:
        import cupy
        from cupyx.scipy.sparse import csr_matrix, diags
        from cupyx.scipy.sparse import linalg as cupy_linalg

        matrix, scale = pencil.stiffness.to_scipy().tocsr(), np.asarray(1 / root).ravel()
        own = diags(cupy.asarray(scale)) @ csr_matrix(matrix) @ diags(cupy.asarray(scale))
        shifted = top * diags(cupy.ones(n**3, "float32")) - own
        if name == "eigsh":
            return top - cupy.asnumpy(cupy_linalg.eigsh(shifted, k, which="LA", return_eigenvectors=False))
        start = cupy.random.default_rng(0).standard_normal((n**3, k), "float32")
        return top - cupy.asnumpy(cupy_linalg.lobpcg(shifted, start, largest=True, maxiter=500)[0])

    ways: dict[str, Callable[[], Any]] = {"jax lobpcg_standard, 500 steps": by_lobpcg}
    ways |= {f"CuPy {name}": partial(by_cupy, name) for name in ("eigsh", "lobpcg")}
    for way, of_way in ways.items():
        try:
            first, _ = timed_once(of_way)
            seconds, values = timed_once(of_way)
        except Exception as error:  # not installed, say, or out of memory
            yield {"way": way, "not_run": f"{type(error).__name__}: {str(error).splitlines()[0]}"}
            continue
        exact = np.asarray(pairs.eigenvalues, float)
        error = float(np.max(np.abs(np.sort(np.asarray(values)) - exact)[1:] / exact[1:]))
        yield {"way": way, "first_call_s": first, "seconds": seconds, "ratio": seconds / ours, "error": error}


def main() -> None:
    """Measure, print a table, and write the result file after each part."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", nargs="*", default=CASES, metavar="N/K", help="N³ nodes, K pairs; the largest last")
    parser.add_argument("--sizes", nargs="+", type=int, metavar="N", help="small sides, in place of all the cases")
    parser.add_argument("--on-cpu", metavar="N/K", help="one case, in place of all the cases")
    parser.add_argument("--minutes", type=float, default=9.0)
    parser.add_argument("-o", "--output", type=Path)
    arguments = parser.parse_args()
    small, single = arguments.sizes, arguments.on_cpu
    arguments.output = arguments.output or RESULTS / f"volumes_{'cpu' if single else 'gpu'}.json"
    cases = [(n, 8) for n in small] if small else [tuple(map(int, case.split("/"))) for case in arguments.cases]
    begin = time.perf_counter()
    warnings.simplefilter("ignore", hj.AccuracyWarning)
    rows = json.loads(arguments.output.read_text())["rows"] if arguments.output.exists() else []
    rows = [row for row in rows if "not_run" not in row]

    def left() -> float:
        return 60 * arguments.minutes - (time.perf_counter() - begin)

    def keep(row: dict) -> None:
        print(row, flush=True)
        rows.append(row)
        write(arguments.output, rows, dtype="float32", box=LENGTHS.tolist())

    def attempt(what: str, n: int, k: int, part: Callable[[], Any], seconds: float = 0.0, rest: float = 0.0) -> None:
        """Measure a part, unless it is in the file, or would leave less than ``rest`` seconds to others."""
        case = {"what": what, "nodes": n**3, "k": k}
        if any(case.items() <= row.items() for row in rows):
            return
        if seconds > left() - rest:
            keep(case | {"not_run": f"would take {seconds:.0f} s, but {left():.0f} s are left"})
            return
        try:
            found = part()
            for row in [found] if isinstance(found, dict) else found:
                keep(case | row)
        except jax.errors.JaxRuntimeError as error:  # out of memory, say: other parts may do
            keep(case | {"not_run": str(error).splitlines()[0]})

    if single:
        n, k = map(int, single.split("/"))
        attempt("eigenpairs", n, k, partial(on_cpu, n, k))
        return
    for n, k in cases:
        expected, done = 0.0, [row for row in rows if "first_call_s" in row and row["what"] == "eigenpairs"]
        if done:  # the degrees of the polynomials are proportional to n
            last, work = done[-1], (n**4 * k) / (done[-1]["nodes"] ** (4 / 3) * done[-1]["k"])
            expected = last["first_call_s"] - last["seconds"] + 2 * work * last["seconds"]
        attempt("eigenpairs", n, k, partial(measure, n, k), expected, REST)
    n, k = (small[0], 8) if small else (128, 200)
    attempt("gradient", n, k, partial(gradient, n, k))
    accelerator.LONGEST = max(left() - REST / 2, 0.0)
    attempt("colouring", n, 0, partial(accelerator.measure_small_times, n))
    n, k = (small[0], 8) if small else (64, 100)
    attempt("eigensolvers", n, k, partial(others, n, k))


if __name__ == "__main__":
    main()
