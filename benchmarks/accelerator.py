"""Everything this project measures on a GPU, in one call: large grids, a batch of small ones, and a gradient.

    python benchmarks/accelerator.py [--cases 256/500 1024/500 ...] [--float32] [-o FILE]

Runs on whatever device JAX finds, prints a table, and writes a result file with the device's name. "host-driven" is the
solver as it is called plainly, "whole" the same compiled into one computation.
"""

import argparse
import warnings
from collections.abc import Callable
from pathlib import Path

import batch
import jax
import jax.numpy as jnp
from machine import RESULTS, field, timed_from_cold, write

import hks_jax as hj

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


def main() -> None:
    """Measure, print a table, and write the result file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", nargs="+", default=CASES, metavar="N/K", help="N² nodes, K pairs")
    parser.add_argument("--float32", action="store_true")
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
    write(output, rows, dtype=dtype, batch=batch.measure(100, 64, 100))


if __name__ == "__main__":
    main()
