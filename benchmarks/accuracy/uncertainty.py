"""Error bars: how often intervals hold the truth, and their cost.

    python benchmarks/accuracy/uncertainty.py [--repeats 200] [--only coverage|cost]

Coverage: smooth fields with known truth on a square, a disc in its box, a cube and a sphere; four signatures of them;
tensors measured with independent noise, of 1 to 20 % of the mean diffusivity; each measurement has intervals of its
own, which hold the truth or not. Cost: a slice of 128² nodes at eight times.
"""

import argparse
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

import jax
import jax.numpy as jnp
import numpy as np

jax.config.update("jax_enable_x64", True)

from machine import RESULTS, write  # noqa: E402

import hks_jax as hj  # noqa: E402

LEVELS = (0.01, 0.02, 0.05, 0.1, 0.2)
CLAIMS = (0.68, 0.95)


def smooth(nodes: np.ndarray, d: int) -> np.ndarray:
    """Return tensors (…, d, d) of eigenvalues in the ratio 2.5 that turn and grow with the place."""
    x = np.pi * nodes / (np.ptp(nodes.reshape(-1, nodes.shape[-1]), axis=0) + 1e-9)
    angle = 0.8 * np.sin(2 * x[..., 0]) + 0.6 * np.cos(2 * x[..., 1])
    u = np.stack([np.cos(angle), np.sin(angle), 0.5 * np.sin(x[..., -1])], axis=-1)[..., :d]
    u /= np.linalg.norm(u, axis=-1, keepdims=True)
    size = np.exp(0.3 * np.sin(2 * (x[..., 0] + x[..., 1])))
    return size[..., None, None] * (0.6 * np.eye(d) + 0.9 * u[..., :, None] * u[..., None, :])


def domains() -> dict[str, tuple[np.ndarray, Callable[[Any], Any], str, float]]:
    """Return tensors, a function from tensors to a domain, the boundary, and the smallest time, by name."""
    found: dict[str, tuple[np.ndarray, Callable[[Any], Any], str, float]] = {}
    disc = np.add.outer((np.arange(13) - 6) ** 2, (np.arange(13) - 6) ** 2) <= 36
    for name, grid, boundary in (
        ("square", hj.Grid((12, 12)), "neumann"),
        ("disc", hj.Grid((13, 13), mask=disc), "mean"),
        ("cube", hj.Grid((6, 6, 6)), "neumann"),
    ):
        tensors = smooth(grid.nodes, grid.dimension)
        found[name] = tensors, lambda D, grid=grid: hj.TensorField.from_diffusion(grid, D, "inverse"), boundary, 2.0
    sphere = hj.examples.sphere_mesh(2)
    tensors = smooth(np.asarray(sphere.vertices), 3)
    vertices, faces = np.asarray(sphere.vertices), np.asarray(sphere.faces)
    found["sphere"] = (
        tensors,
        lambda D: hj.SurfaceMesh.from_tensors(vertices, faces, D, metric="inverse"),
        "neumann",
        0.1,
    )
    return found


def signatures(
    domain: Callable[[Any], Any], boundary: str, first: float, k: int, source: list[int]
) -> Callable[[Any], dict[str, Any]]:
    """Return a function from tensors to four signatures, all of one computation of eigenpairs."""
    times = first * np.array([1.0, 4.0, 16.0])

    @jax.jit
    def compute(D: Any) -> dict[str, Any]:
        pairs = hj.eigenpairs(domain(D), k, boundary, solver="dense")
        fine = jnp.geomspace(times[0], times[-1], 32)
        return {
            "HKS": hj.hks(pairs, times, "flat"),
            "WKS": hj.wks(pairs, -np.log(times[::-1] / 2), 0.7),
            "scale-invariant HKS": hj.scale_invariant_hks(pairs, 3, times=fine),
            "diffusion distance": hj.diffusion_distance(pairs, times, source)[:, 0],
        }

    return compute


def coverage(repeats: int) -> list[dict[str, Any]]:
    """Measure how often intervals hold the truth, one row for each domain, signature, level and entry."""
    rows = []
    for name, (tensors, domain, boundary, first) in domains().items():
        D = jnp.asarray(tensors)
        source = [7] if name == "sphere" else [5] * (D.ndim - 2)
        compute = signatures(domain, boundary, first, int(np.prod(D.shape[:-2])) // 2, source)
        measure = measurements(compute, D, jnp.arange(repeats))
        for level in LEVELS:
            for kind, entries in measure(level).items():
                for entry, numbers in enumerate(np.stack(list(entries.values())).T):
                    row = {"domain": name, "signature": kind, "noise": level, "entry": entry}
                    rows.append(row | {key: round(float(x), 4) for key, x in zip(entries, numbers, strict=True)})
                    print(*rows[-1].values(), flush=True)
    return rows


def summary(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return one row for each domain and level: how many maps are claimed, and how often intervals hold the truth."""
    found = []
    for name, level in dict.fromkeys((row["domain"], row["noise"]) for row in rows):
        those = [row for row in rows if (row["domain"], row["noise"]) == (name, level)]
        claimed = [row for row in those if row["claimed"] > 0.5]
        line = {"domain": name, "noise": level, "maps": len(those), "maps_claimed": len(claimed)}
        for key, group in (("claimed", claimed), ("all", those)):
            for part in ("in_68", "in_95"):
                line[f"{part}_{key}"] = float(np.mean([row[part] for row in group])) if group else None
        worst = max((abs(row["in_68"] - 0.68) for row in claimed), default=None)
        found.append(
            line | {"worst_68": worst, "uncorrected": float(np.mean([row["uncorrected_in_68"] for row in those]))}
        )
    return found


def measurements(compute: Callable[[Any], Any], D: Any, seeds: Any) -> Callable[[float], dict[str, Any]]:
    """Return a function from a level of noise to the mean over many measurements of these tensors."""
    truth = compute(D)

    @jax.jit
    def all_of(level: Any) -> Any:
        def one(seed: Any) -> Any:
            exact = relative(D, level)
            white = jax.random.normal(jax.random.key(seed + 1_000_000), exact.covariance.shape[:-1])
            values, vectors = jnp.linalg.eigh(D + exact.tensors(white))
            # As a scan's repair raises them.
            measured = jnp.einsum("...ia,...a,...ja->...ij", vectors, jnp.maximum(values, 0.01), vectors)
            bars = hj.uncertainty(compute, measured, relative(measured, level), method="resample", seed=seed)
            return jax.tree.map(
                lambda true, low, high, low95, high95, value, deviation, bias, beyond, claimed: judged(
                    true, (low, high), (low95, high95), value, deviation, bias, beyond, claimed
                ),
                truth,
                *bars.interval(CLAIMS[0]),
                *bars.interval(CLAIMS[1]),
                *(bars.value, bars.deviation, bars.bias, bars.beyond_linear, bars.trusted),
            )

        return jax.tree.map(lambda x: jnp.mean(x, axis=0), jax.lax.map(one, seeds))

    return lambda level: all_of(jnp.asarray(level))


def relative(D: Any, level: Any) -> hj.TensorNoise:
    """Return noise relative to the mean diffusivity, of a level that is traced."""
    return hj.TensorNoise(hj.TensorNoise.relative(D, 1.0).covariance * level**2)


def judged(
    true: Any, first: Any, second: Any, value: Any, deviation: Any, bias: Any, beyond: Any, claimed: Any
) -> dict[str, Any]:
    """Return for each entry the share of nodes with the truth inside, and the medians that decide on claims."""
    known = (jnp.isfinite(true) & (deviation > 1e-12)).reshape(len(true), -1)

    def share(hit: Any) -> Any:
        return jnp.sum(hit.reshape(known.shape) & known, axis=1) / known.sum(axis=1)

    def median(x: Any) -> Any:
        return jnp.nanmedian(jnp.where(known, x.reshape(known.shape), jnp.nan), axis=1)

    return {
        "in_68": share((first[0] < true) & (true < first[1])),
        "in_95": share((second[0] < true) & (true < second[1])),
        "uncorrected_in_68": share(jnp.abs(value - true) < deviation),
        "claimed": claimed.astype(float),
        "bias_over_deviation": median(jnp.abs(bias / deviation)),
        "beyond_linear": median(beyond),
    }


def cost(n: int = 128, k: int = 150) -> list[dict[str, Any]]:
    """Measure error bars of a slice at eight times against the map itself, in seconds of processors."""
    grid = hj.Grid((n, n))
    D = jnp.asarray(smooth(grid.nodes, 2))
    times = np.geomspace(8, 200, 8)

    def signature(D: Any) -> Any:
        return hj.hks(hj.eigenpairs(hj.TensorField.from_diffusion(grid, D, "inverse"), k), times, "flat")

    compiled = jax.jit(signature)

    def seconds(function: Callable[[], Any]) -> float:
        start = time.process_time()
        jax.block_until_ready(function())
        return time.process_time() - start

    def bars(draws: int) -> hj.Uncertainty:
        noise = hj.TensorNoise.relative(D, 0.05)
        return hj.uncertainty(compiled, D, noise, method="resample", draws=draws, compiled=False)

    found = {draws: bars(draws) for draws in (8, 16)}  # compiles
    # In turn, since other programs slow all of them, and the shortest of each.
    rounds = [
        [seconds(run) for run in (lambda: compiled(D + 0.0), lambda: bars(8), lambda: bars(16))] for _ in range(4)
    ]
    alone, *whole = np.min(rounds, axis=0).tolist()
    return [
        {
            **{"nodes": n * n, "k": k, "draws": draws, "map_seconds": alone, "error_bars_seconds": total},
            **{"times_the_map": total / alone, "sampling_error": found[draws].sampling_error},
        }
        for draws, total in zip((8, 16), whole, strict=True)
    ]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=200)
    parser.add_argument("--only", choices=("coverage", "cost"))
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "uncertainty.json")
    args = parser.parse_args()
    warnings.simplefilter("ignore", hj.AccuracyWarning)
    found = {}
    if args.only != "coverage":
        found["cost"] = cost()
        print(found["cost"])
    if args.only != "cost":
        found["coverage"] = coverage(args.repeats)
        found["summary"] = summary(found["coverage"])
    write(args.output, found, repeats=args.repeats)
