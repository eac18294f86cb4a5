"""Fits of a metric to its signature: their errors and their cost.

    python benchmarks/derivatives/inverse.py                           # everything
    python benchmarks/derivatives/inverse.py --cases curve optimisers  # these; the others stay as they are in the file

Fields are smooth, on the unit square; fits start from the flat metric; seven times. Errors are relative, of the
tensors, in the Frobenius norm over all nodes.
"""

import argparse
import json
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

import jax
import jax.numpy as jnp
import numpy as np
from machine import RESULTS, write

import hks_jax as hj
from hks_jax.domain import spd
from hks_jax.inverse import H1, Data, Regulariser, Search


def conformal(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A wave and a bump in the conformal factor."""
    bump = 0.3 * np.exp(-((x - 0.6) ** 2 + (y - 0.4) ** 2) / 0.02)
    factor = 0.5 * np.sin(2 * np.pi * x) * np.cos(np.pi * y) + bump
    return np.exp(factor)[..., None, None] * np.eye(2)


def full(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """All three components vary."""
    a, b = np.sin(2 * np.pi * x) * np.cos(np.pi * y), np.cos(np.pi * x) * np.cos(2 * np.pi * y)
    c = np.sin(np.pi * x + y)
    rows = [np.stack([a, c], axis=-1), np.stack([c, b], axis=-1)]
    return np.asarray(spd.exp(0.4 * jnp.asarray(np.stack(rows, axis=-2))))


KINDS: dict[str, tuple[Callable, float, int]] = {
    "conformal": (conformal, 0.0045, 139),
    "log-euclidean": (full, 0.0023, 267),
}
"""Tensors, the smallest time, and k: the same for target and fit, so that the rest of the spectrum does not matter."""


def setting(n: int, kind: str, refined: int = 1) -> tuple[hj.TensorField, np.ndarray, np.ndarray, int]:
    """Return the truth on n² nodes, times, the target (made on a grid `refined` times as fine), and k."""
    tensors, smallest, k = KINDS[kind]
    k = min(k, n * n // 4)  # more are far from those of the manifold
    times = np.geomspace(smallest, 0.13, 7)
    fields = []
    for size in (n, refined * (n - 1) + 1):
        grid = hj.Grid((size, size), 1 / (size - 1))
        fields.append(hj.TensorField(grid, tensors(grid.nodes[..., 0], grid.nodes[..., 1])))
    target = hj.hks(hj.eigenpairs(fields[1], k), times)[:, ::refined, ::refined]
    return fields[0], times, np.asarray(target), k


def run(
    n: int,
    kind: str,
    noise: float = 0.0,
    refined: int = 1,
    bias: bool = False,
    regularisers: Sequence[Regulariser] = (),
    **search: Any,
) -> dict:
    """Fit once; with bias, the discretisation's difference at the truth counts as noise."""
    truth, times, target, k = setting(n, kind, refined)
    target = target * np.exp(noise * np.random.default_rng(1).standard_normal(target.shape))
    level = noise if noise and not regularisers else None
    if bias:
        difference = np.log(np.asarray(hj.hks(hj.eigenpairs(truth, k), times)) / target)
        level = float(np.sqrt(np.mean(difference**2)))
    start = time.perf_counter()
    fit = hj.fit_metric(
        truth.grid, target, times, kind, k=k, data=Data(noise=level), regularisers=regularisers, search=Search(**search)
    )
    seconds = time.perf_counter() - start
    error = float(np.linalg.norm(fit.field.tensors - truth.tensors) / np.linalg.norm(truth.tensors))
    row = {"nodes": n * n, "parametrisation": kind, "noise": noise, "refined": refined, "k": k, "error": error}
    row |= {
        "level": level,
        "seconds": seconds,
        "result": fit.result,
        "loss": fit.loss,
        "misfit": fit.misfit,
    }
    row["history"] = [{"loss": step.loss, "seconds": step.seconds} for step in fit.history]
    told = "" if level is None else f", stops at {level:.2g}"
    print(f"{n}² {kind}, noise {noise:g}, target on {refined}× finer grid{told}: error {error:.2e}, ", end="")
    print(f"{fit.steps} steps, {seconds:.0f} s, {fit.result}, misfit {fit.misfit:.2e}", flush=True)
    return row


def recover() -> list[dict]:
    """Noise-free and noisy recovery."""
    return [
        run(64, "conformal", tolerance=1e-3),
        run(64, "conformal", 0.01),
        run(32, "log-euclidean", max_steps=6),
        run(32, "log-euclidean", 0.01),
    ]


def large() -> list[dict]:
    """A full field on 64² nodes."""
    return [run(64, "log-euclidean", max_steps=5)]


def crime() -> list[dict]:
    """Targets made on a finer grid than the fit's."""
    return [run(32, kind, refined=2, bias=bias, max_steps=6) for kind in KINDS for bias in (False, True)]


def curve() -> list[dict]:
    """The error against the weight of a penalty, with noise, and the error by the discrepancy principle."""
    rows = [run(32, "log-euclidean", 0.01)]
    for weight in (1e-9, 1e-8, 1e-7, 1e-6, 1e-5):
        row = run(32, "log-euclidean", 0.01, regularisers=[H1(weight)], max_steps=8)
        rows.append(row | {"weight": weight})
    return rows


def optimisers() -> list[dict]:
    """Gauss–Newton beside L-BFGS: each step computes one signature."""
    return [
        run(24, "conformal", optimiser=name, max_steps=steps, tolerance=1e-9) | {"optimiser": name}
        for name, steps in (("gauss-newton", 6), ("lbfgs", 150))
    ]


CASES = {each.__name__: each for each in (recover, crime, curve, optimisers, large)}


def main() -> None:
    """Run the cases and write the results."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "inverse.json")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    warnings.simplefilter("ignore", hj.AccuracyWarning)
    rows = json.loads(arguments.output.read_text())["rows"] if arguments.output.exists() else {}
    for case in arguments.cases:
        rows[case] = CASES[case]()
        write(arguments.output, rows)


if __name__ == "__main__":
    main()
