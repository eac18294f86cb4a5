"""How many factorisations and searches block Lanczos takes, over the number that an ideal run would.

    python benchmarks/eigensolvers/slices.py [--fields 20] [-o FILE]

Ideal are as many searches as slices, and one factorisation more for the certificate. Fields: random smooth ones of
anisotropies from mild to strong, and one that stalled an earlier version, whose certificate fell on a twin of the last
eigenvalue.
"""

import argparse
import sys
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import jax
import jax.numpy as jnp
import numpy as np

jax.config.update("jax_enable_x64", True)

from machine import RESULTS, write  # noqa: E402

import hks_jax as hj  # noqa: E402
from hks_jax.eigen.lanczos.block_lanczos import expected  # noqa: E402
from hks_jax.eigen.lanczos.slicing import cut, first_state, search, unfinished  # noqa: E402
from hks_jax.fem.pencil import Pencil  # noqa: E402
from hks_jax.linear.dissection import dissect  # noqa: E402

TOLERANCE = 1e-8
CASES = ((64, 100, 8), (64, 340, 6), (128, 200, 1))
"""Nodes along an axis, pairs, and how many times ``--fields`` fields."""


def smooth(seed: int, n: int) -> Pencil:
    """Return the pencil of a random smooth field: the exponential of a few waves."""
    rng = np.random.default_rng(seed)
    grid = hj.Grid.from_bounds(-1.0, 1.0, shape=(n, n))

    def waves() -> np.ndarray:
        total = np.zeros((n, n))
        for _ in range(4):
            direction = rng.normal(size=2) * rng.uniform(0.5, 4)
            total += rng.normal() / 2 * np.sin(grid.nodes @ direction + rng.uniform(0, 6))
        return total

    a = np.stack([np.stack([waves(), waves()], -1), np.stack([waves(), waves()], -1)], -1)
    values, vectors = np.linalg.eigh((a + np.swapaxes(a, -1, -2)) / 2 * rng.choice([0.3, 1.0, 2.0]))
    return hj.assemble(hj.TensorField(grid, np.einsum("...ia,...a,...ja->...ij", vectors, np.exp(values), vectors)))


def stalling(n: int) -> Pencil:
    """Return the pencil of a field whose spectrum has nearly equal neighbours."""
    grid = hj.Grid.from_bounds(-5.0, 5.0, shape=(n, n))
    x, y = grid.nodes[..., 0], grid.nodes[..., 1]
    off = 0.7 * np.sin(x) * np.cos(y)
    rows = [np.stack([1 + 10 * np.exp(-(y**2)), off], -1), np.stack([off, 1 + 10 * np.exp(-(x**2))], -1)]
    return hj.assemble(hj.TensorField(grid, jnp.asarray(np.stack(rows, -2))))


def count(pencil: Pencil, k: int) -> tuple[int, int, bool]:
    """Return the factorisations and searches beyond the ideal numbers, and whether all was found."""
    plan = hj.BlockLanczos(TOLERANCE).plan(k, pencil.space.n_null)
    problem = expected(pencil, plan)
    slices = max(round(k / 170), 1)
    dissection, both, searches = jax.device_put(dissect(pencil.pattern)), first_state(problem, plan), 0
    while unfinished(plan, both[0]):
        factor, searchable, both = cut(problem, dissection, plan, *both)
        if searchable:
            both, searches = search(problem, factor, plan, both), searches + 1
    state = both[0]
    return int(state.slices) - slices - 1, searches - slices, bool(state.finished)


def row(field: str, n: int, k: int, counts: list[tuple[int, int, bool]]) -> dict:
    """Return a row of the table."""
    factorisations = Counter(extra for extra, _, _ in counts)
    print(f"{field} {n}²/{k}: {dict(factorisations)} factorisations beyond the ideal", flush=True)
    return {
        "field": field,
        "nodes": n * n,
        "k": k,
        "fields": len(counts),
        "ideal": sum(extra <= 0 for extra, _, _ in counts),
        "one_more": factorisations[1],
        "worse": sum(extra > 1 for extra, _, _ in counts),
        "more_searches": sum(extra > 0 for _, extra, _ in counts),
        "not_found": sum(not finished for _, _, finished in counts),
    }


def main() -> None:
    """Count, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--fields", type=int, default=20)
    parser.add_argument("-o", type=Path, default=RESULTS / "slices.json")
    arguments = parser.parse_args()
    rows = []
    for n, k, times in CASES:
        counts = [count(smooth(seed, n), k + 1) for seed in range(times * arguments.fields)]
        rows.append(row("smooth", n, k, counts))
    rows.append(row("near twins", 256, 500, [count(stalling(256), 501)]))
    write(arguments.o, rows, tolerance=TOLERANCE)


if __name__ == "__main__":
    main()
