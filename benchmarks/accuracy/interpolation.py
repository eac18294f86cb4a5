"""Linear and log-Euclidean interpolation of tensors between the nodes: errors, orders, and the estimate beside them.

    python benchmarks/accuracy/interpolation.py [--brain TENSORS MASK SLICE] [-o FILE]

Fields: eigenvalues (r, 1), in 3D (r, 1, √r), which turn on [−1, 1]^d; the error is the median over the coarse nodes of
the signature's relative error against a grid several times finer. Brains: every second voxel is kept, and the signature
there compared with that of all voxels, interpolated either way; the one that the wheel mdt carries, where it is
installed, and any other given. Absent ones are left out.
"""

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

import jax
import numpy as np

jax.config.update("jax_enable_x64", True)

from machine import RESULTS, field, timed, write  # noqa: E402

import hks_jax as hj  # noqa: E402
from hks_jax.io.dwi import find_example_brain  # noqa: E402

WAYS = ("linear", "log-euclidean")
LENGTHS = (6.0, 12.0)
"""√(Dt) on the brains, in voxels of the full resolution, D the median diffusivity."""


def turning(grid: hj.Grid, r: float, rate: float) -> np.ndarray:
    """Return tensors of eigenvalues (r, 1) or (r, 1, √r) at the angle rate·(2x + y), in 3D tilted by rate·(z − x)."""
    x = grid.nodes
    frame = rotation(rate * (2 * x[..., 0] + x[..., 1]), 0, 1, grid.dimension)
    values = [r, 1.0]
    if grid.dimension == 3:
        frame = frame @ rotation(rate * (x[..., 2] - x[..., 0]), 1, 2, 3)
        values.append(np.sqrt(r))
    return np.einsum("...ia,a,...ja->...ij", frame, values, frame)


def rotation(angle: np.ndarray, a: int, b: int, d: int) -> np.ndarray:
    """Return rotations in the plane of axes a and b."""
    matrix = np.broadcast_to(np.eye(d), (*angle.shape, d, d)).copy()
    matrix[..., a, a] = matrix[..., b, b] = np.cos(angle)
    matrix[..., a, b], matrix[..., b, a] = -np.sin(angle), np.sin(angle)
    return matrix


def solve(given: hj.TensorField, k: int, times: np.ndarray) -> tuple[np.ndarray, hj.Truncation, float]:
    """Return the signature, its estimated errors, and the volume."""
    pairs = hj.eigenpairs(given, k)
    return np.asarray(hj.hks(pairs, times)), hj.truncation(pairs, times), float(pairs.pencil.volume)


def fields(d: int, sizes: tuple[int, ...], reference: int, k: int, times: np.ndarray) -> Iterator[dict[str, Any]]:
    """Measure the errors on fields that turn, and the orders between the last two sizes."""
    for r in (3.0, 10.0, 30.0) if d == 2 else (10.0,):
        fine, _, volume = solve(at(d, reference, r, "log-euclidean"), k, times)
        for way in WAYS:
            rows: list[dict[str, Any]] = []
            for n in sizes:
                found, estimate, found_volume = solve(at(d, n, r, way), k, times)
                step = (reference - 1) // (n - 1)
                there = fine[(slice(None), *[slice(None, None, step)] * d)]
                errors = np.median(np.abs(found / there - 1), axis=tuple(range(1, d + 1)))
                rows += [
                    {
                        "d": d,
                        "ratio": r,
                        "interpolation": way,
                        "nodes_per_axis": n,
                        "t": float(t),
                        "error": float(error),
                        "estimate": float(said),
                        "volume_error": abs(found_volume / volume - 1),
                    }
                    for t, error, said in zip(times, errors, np.asarray(estimate.resolution_bias), strict=True)
                ]
            for before, row in zip(rows[-2 * len(times) :], rows[-len(times) :], strict=False):
                refined = np.log((row["nodes_per_axis"] - 1) / (before["nodes_per_axis"] - 1))
                row["order"] = float(np.log(before["error"] / row["error"]) / refined)
            yield from rows


def at(d: int, n: int, r: float, way: Any) -> hj.TensorField:
    """Return the turning field on n^d nodes."""
    grid = hj.Grid.from_bounds(-1, 1, (n,) * d)
    return hj.TensorField(grid, turning(grid, r, 1.0), way)


def brain(name: str, volume: hj.io.TensorVolume) -> Iterator[dict[str, Any]]:
    """Measure the error of a brain slice's interpolation from every second voxel."""
    assert volume.mask is not None
    diffusivity = np.median(np.trace(volume.tensors[volume.mask], axis1=-2, axis2=-1)) / 2
    lengths = np.array(LENGTHS) * min(volume.spacing)
    times = {"inverse": lengths**2 / diffusivity, "tensor": lengths**2 * diffusivity}
    grid = volume.grid("largest")
    half = tuple(slice(None, None, 2) for _ in grid.shape)
    coarse = hj.Grid(grid.inside[half].shape, [2 * h for h in grid.spacing], grid.origin, grid.inside[half], "largest")
    tensors = np.asarray(volume.tensors, np.float64)
    for metric, those in times.items():
        fine = {w: solve(of(grid, tensors, metric, w), 250, those) for w in WAYS}
        apart = np.nanmedian(np.abs(fine[WAYS[0]][0] / fine[WAYS[1]][0] - 1), axis=(1, 2))
        for way in WAYS:
            print(name, metric, way, flush=True)
            found, estimate, _ = solve(of(coarse, tensors[half], metric, way), 200, those)
            same = fine[way][0][(slice(None), *half)]
            other = fine[WAYS[1 - WAYS.index(way)]][0][(slice(None), *half)]
            for i, (length, t) in enumerate(zip(LENGTHS, those, strict=True)):
                yield {
                    "brain": name,
                    "metric": metric,
                    "interpolation": way,
                    "length_in_voxels": length,
                    "t": float(t),
                    "from_its_own": float(np.nanmedian(np.abs(found[i] / same[i] - 1))),
                    "from_the_other": float(np.nanmedian(np.abs(found[i] / other[i] - 1))),
                    "apart_on_all_voxels": float(apart[i]),
                    "estimate": float(estimate.resolution_bias[i]),
                    "lasting": float(estimate.lasting_bias[i]),
                }


def of(grid: hj.Grid, tensors: np.ndarray, metric: Any, way: Any) -> hj.TensorField:
    """Return the metric of diffusion tensors."""
    return hj.TensorField.from_diffusion(grid, tensors, metric, interpolation=way)


def brains(given: list[str] | None) -> Iterator[dict[str, Any]]:
    """Measure the brains that are there."""
    example = find_example_brain()
    if example is not None:
        volume = hj.io.fit_dwi(example.images, example.bval, example.bvec, example.mask, b_max=1100)
        assert volume.mask is not None
        yield from brain("mdt", volume.with_mask(hj.io.erode(volume.mask, 2)).slice("z", 1))
    if given is not None:
        tensors, mask, index = given
        yield from brain(
            Path(tensors).name.split(".")[0], hj.io.read_tensors(tensors, mask=mask).slice("z", int(index))
        )


def assembly() -> Iterator[dict[str, Any]]:
    """Measure assembly, compiled."""
    for n, d in ((256, 2), (40, 3)):
        given = field(n, d)
        for way in WAYS:
            assemble = jax.jit(lambda T: hj.assemble(hj.TensorField(given.grid, T, way)))  # noqa: B023
            seconds, _ = timed(assemble, given.tensors, repeats=5)
            yield {"shape": [n] * d, "interpolation": way, "seconds": seconds}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--brain", nargs=3, metavar=("TENSORS", "MASK", "SLICE"), help="another brain")
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "interpolation.json")
    args = parser.parse_args()
    found = {
        "assembly": list(assembly()),
        "brains": list(brains(args.brain)),
        "fields": [
            *fields(2, (21, 41), 121, 60, np.array([0.4, 1.6, 5.0])),
            *fields(3, (7, 13), 25, 30, np.array([0.8, 2.5, 5.0])),
        ],
    }
    write(args.output, found)
