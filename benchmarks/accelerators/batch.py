"""Many small problems: the eigenpairs of a batch of fields, one after another, mapped and vectorised.

    python benchmarks/accelerators/batch.py [--fields 100] [--nodes 64] [--pairs 100] [--float32] [-o FILE]

Runs on the device that JAX finds. The result file holds fields per second, the compilation apart, and the machine.
"""

import argparse
import sys
import warnings
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import jax
import jax.numpy as jnp
import numpy as np
from machine import RESULTS, field, timed_from_cold, write

import hks_jax as hj


def measure(count: int, n: int, k: int) -> list[dict]:
    """Measure every way to solve many fields of n² nodes, and print a table."""
    first = field(n)
    scales = np.exp(np.random.default_rng(0).uniform(-1, 1, (count, n, n, 1, 1)))
    tensors = jnp.asarray(scales * np.asarray(first.tensors))

    def spectrum(solver: str) -> Callable[[jax.Array], tuple[jax.Array, jax.Array]]:
        def solve(some: jax.Array) -> tuple[jax.Array, jax.Array]:
            pairs = hj.eigenpairs(hj.TensorField(first.grid, some), k, solver=solver)
            return pairs.eigenvalues, jnp.max(pairs.residuals)

        return solve

    ours = spectrum("block-lanczos")
    ways = {
        "one by one": lambda T: jax.tree.map(lambda *a: jnp.stack(a), *map(ours, T)),
        "one by one, shift-invert": lambda T: jax.tree.map(lambda *a: jnp.stack(a), *map(spectrum("shift-invert"), T)),
        "lax.map": jax.jit(lambda T: jax.lax.map(ours, T)),
        "vmap, tens": jax.jit(lambda T: jax.lax.map(ours, T, batch_size=10)),
    }
    rows, reference = [], None
    for name, run in ways.items():
        once, seconds, (values, residuals) = timed_from_cold(run, tensors, repeats=1)
        reference = values if reference is None else reference
        difference = float(jnp.max(jnp.abs(values - reference) / jnp.maximum(reference, reference[:, 1:2])))
        row = {"way": name, "seconds": seconds, "fields_per_second": count / seconds, "first_call_s": once}
        rows.append(row | {"worst_residual": float(residuals.max()), "eigenvalue_difference": difference})
        print(f"{name:26s} {seconds:8.2f} s {count / seconds:8.2f} fields/s, residual {float(residuals.max()):.1e}")
    return rows


def main() -> None:
    """Measure, print a table, and write the result file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--fields", type=int, default=100)
    parser.add_argument("--nodes", type=int, default=64, help="along each axis")
    parser.add_argument("--pairs", type=int, default=100)
    parser.add_argument("--float32", action="store_true")
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "batch.json")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", not arguments.float32)
    warnings.simplefilter("ignore", hj.AccuracyWarning)
    rows = measure(arguments.fields, arguments.nodes, arguments.pairs)
    sizes = {"nodes": arguments.nodes**2, "k": arguments.pairs, "fields": arguments.fields}
    write(arguments.output, rows, **sizes, dtype="float32" if arguments.float32 else "float64")


if __name__ == "__main__":
    main()
