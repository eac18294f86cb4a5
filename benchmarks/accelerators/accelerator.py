"""Everything this project measures on a GPU, in one call: large grids and volumes, a batch, a gradient, small times.

    python benchmarks/accelerators/accelerator.py [--cases 256/500 ...] [--volumes 128/500 ...] [--float32] [-o FILE]

Runs on the device that JAX finds, prints a table, and writes a result file with the device's name. "host-driven" is the
solver as it is called plainly, "whole" the same compiled into one computation. Volumes, and signatures without a
spectrum on the largest of them, are in float32 in any case; of these signatures only those that, by the speed of the
one before, take less than ten minutes.
"""

import argparse
import math
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import batch
import jax
import jax.numpy as jnp
from machine import RESULTS, field, timed_from_cold, timed_once, write

import hks_jax as hj

VOLUMES = ["64/200", "128/500", "256/500"]
TIMES_IN_H2 = [2, 4, 8, 16, 32, 64, 128]
LONGEST = 600.0
CASES = ["64/100", "256/100", "256/500", "512/500", "1024/100", "1024/500"]


def measure(n: int, k: int) -> list[dict]:
    """Measure both ways to call the solver on n² nodes."""
    given = field(n)

    def solve(tensors: jax.Array) -> hj.Eigenpairs:
        return hj.eigenpairs(hj.TensorField(given.grid, tensors), k, solver="block-lanczos")

    def loss(tensors: jax.Array) -> jax.Array:
        return jnp.sum(jnp.log(hj.hks(solve(tensors), jnp.array([1e-2, 1e-1]))))

    ways: dict[str, Callable] = {"host-driven": solve, "whole": jax.jit(solve)}
    if n <= 256:
        ways["gradient of the HKS"] = jax.value_and_grad(loss)
    rows = []
    for way, run in ways.items():
        try:
            first, seconds, found = timed_from_cold(run, given.tensors, repeats=2)
        except jax.errors.JaxRuntimeError as error:  # out of memory, say: the other cases may do
            print(f"{n:5d}² {k:4d} {way:20s} {str(error).splitlines()[0]}")
            rows.append({"nodes": n * n, "k": k, "way": way, "not_run": str(error).splitlines()[0]})
            continue
        row = {"nodes": n * n, "k": k, "way": way, "seconds": seconds, "first_call_s": first}
        if isinstance(found, hj.Eigenpairs):
            row["worst_residual"] = float(found.residuals.max())
            row["none_missed"] = bool(found.complete_below > found.eigenvalues[-1])
        rows.append(row)
        print(f"{n:5d}² {k:4d} {way:20s} {seconds:8.3f} s, first call {first:6.1f} s, ", end="")
        print(f"residual {row.get('worst_residual', float('nan')):.1e}, none missed: {row.get('none_missed', '-')}")
    return rows


def measure_volume(n: int, k: int) -> dict:
    """Measure the matrix-free solver on n³ nodes in float32."""
    given = field(n, d=3)
    single = hj.TensorField(given.grid, jnp.asarray(given.tensors, jnp.float32))
    row = {"nodes": n**3, "k": k, "way": "Chebyshev filter, float32"}
    try:
        first, seconds, found = timed_from_cold(
            lambda: hj.eigenpairs(single, k, solver="chebyshev-filter", progress=print), repeats=1
        )
    except jax.errors.JaxRuntimeError as error:
        return row | {"not_run": str(error).splitlines()[0]}
    found_well = {"converged": int(found.converged.sum()), "worst_residual": float(found.residuals.max())}
    print(f"{n:5d}³ {k:4d} {seconds:8.1f} s, first call {first:6.1f} s, {found_well}")
    return row | {"seconds": seconds, "first_call_s": first} | found_well


def measure_small_times(n: int) -> Iterator[dict]:
    """Measure signatures without a spectrum on n³ nodes, unit metric, lumped mass, float32, time after time."""
    grid = hj.Grid((n,) * 3, 1 / (n - 1))
    flat = hj.TensorField(grid, jnp.broadcast_to(jnp.eye(3, dtype=jnp.float32), (n, n, n, 3, 3)))
    space = hj.assemble(flat, mass="lumped").space
    speed = math.inf  # products with a vector, a second
    for factor in TIMES_IN_H2:
        t = factor * grid.spacing[0] ** 2
        row = {"nodes": n**3, "t_in_h2": factor}
        try:
            settings = hj.colouring(flat, [t], mass="lumped", tolerance=1e-3)
        except ValueError as error:  # sources as far apart as the grid is wide
            yield row | {"not_run": str(error).splitlines()[0]}
            continue
        row |= {"vectors": settings.n_vectors(space), "degree": settings.degree, "bound": settings.error[0]}
        products = row["vectors"] * row["degree"]
        if products / speed > LONGEST:
            yield row | {"not_run": f"would take {products / speed:.0f} s"}
            continue
        seconds, _ = timed_once(lambda: hj.hks_spectrum_free(flat, [t], mass="lumped", method=settings))  # noqa: B023
        speed = products / seconds
        yield row | {"seconds": seconds, "node_columns_per_second": speed * n**3}


def main() -> None:
    """Measure, print a table, and write the result file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", nargs="+", default=CASES, metavar="N/K", help="N² nodes, K pairs")
    parser.add_argument("--volumes", nargs="*", default=VOLUMES, metavar="N/K", help="N³ nodes, K pairs, float32")
    parser.add_argument("--float32", action="store_true", help="the grids too")
    parser.add_argument("-o", "--output", type=Path)
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", not arguments.float32)
    warnings.simplefilter("ignore", hj.AccuracyWarning)
    dtype = "float32" if arguments.float32 else "float64"
    device = jax.devices()[0].device_kind
    output = arguments.output or RESULTS / f"accelerator_{device.replace(' ', '_')}.json"
    print(device)
    rows: list[dict] = []
    for case in arguments.cases:
        rows += measure(*map(int, case.split("/")))
        write(output, rows, dtype=dtype)
    fields = batch.measure(100, 64, 100)
    write(output, rows, dtype=dtype, batch=fields)
    for case in arguments.volumes:
        rows.append(measure_volume(*map(int, case.split("/"))))
        write(output, rows, dtype=dtype, batch=fields)
    small_times = []
    for row in measure_small_times(max(int(case.split("/")[0]) for case in arguments.volumes or ["32/0"])):
        print(row, flush=True)
        small_times.append(row)
        write(output, rows, dtype=dtype, batch=fields, small_times=small_times)


if __name__ == "__main__":
    main()
