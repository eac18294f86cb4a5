"""The record of a measurement: the machine, the versions, and the file."""

import json
import os
import platform
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import hks_jax as hj
from hks_jax.eigen.quality import measure_pairs
from hks_jax.linear.symmetric_pencil import SymmetricPencil

RESULTS = Path(__file__).parent / "results"


def timed(function: Callable[..., Any], *args: Any, repeats: int = 3) -> tuple[float, Any]:
    """Return the shortest time of several runs after a warm-up, and the result."""
    return timed_from_cold(function, *args, repeats=repeats)[1:]


def timed_from_cold(function: Callable[..., Any], *args: Any, repeats: int) -> tuple[float, float, Any]:
    """Return the time of the first call, compilation included, the shortest of the later ones, and the result."""
    times, result = [], None
    for _ in range(1 + repeats):
        result = None  # not to hold two at once
        seconds, result = timed_once(function, *args)
        times.append(seconds)
    return times[0], min(times[1:]), result


def timed_once(function: Callable[..., Any], *args: Any, **more: Any) -> tuple[float, Any]:
    """Return the time of one call, compilation included, and its result."""
    start = time.perf_counter()
    result = jax.block_until_ready(function(*args, **more))
    return time.perf_counter() - start, result


def field(n: int, d: int = 2) -> hj.TensorField:
    """Anisotropic tensors of eigenvalues 1 … 4 and random directions, n^d nodes on the unit square or cube."""
    rng, shape = np.random.default_rng(n), (n,) * d
    frames = np.linalg.qr(rng.standard_normal((*shape, d, d)))[0]
    values = rng.uniform(1, 4, (*shape, d))
    return hj.TensorField(hj.Grid(shape, 1 / (n - 1)), np.einsum("...ia,...a,...ja->...ij", frames, values, frames))


def relative_residuals(pencil: hj.Pencil, values: jax.Array, vectors: jax.Array, rows: int = 8) -> np.ndarray:
    """Return ‖Kφ − λMφ‖ / ‖Mφ‖ / max(λ, λ₁) of each pair, computed in float64 for a few pairs at a time."""
    found: list[np.ndarray] = []
    with jax.enable_x64(True):
        double = jax.tree.map(lambda x: x.astype(jnp.float64), SymmetricPencil(pencil.stiffness, pencil.mass))
        measure, values = jax.jit(measure_pairs), np.asarray(values, float)
        for first in range(0, len(values), rows):
            some = slice(first, first + rows)
            found.append(np.asarray(measure(double, vectors[some].astype(jnp.float64), jnp.asarray(values[some]))[1]))
    return np.concatenate(found) / np.maximum(values, values[1])


def write(output: Path, rows: Any, **more: Any) -> None:
    """Write rows with the machine and the versions beside them."""
    machine = {"processor": platform.machine(), "cores": os.cpu_count(), "device": jax.devices()[0].device_kind}
    versions = {"python": platform.python_version(), "jax": jax.__version__, "hks_jax": hj.__version__}
    output.parent.mkdir(parents=True, exist_ok=True)
    temporary = output.with_suffix(".part")
    temporary.write_text(json.dumps({"machine": machine, "versions": versions, **more, "rows": rows}, indent=2) + "\n")
    temporary.replace(output)
    print(f"written to {output}")
