"""The quadrature "cancelling" beside "gauss": errors of signatures and eigenvalues, and seconds at equal error.

    python benchmarks/accuracy/quadrature.py [--tensors TENSORS MASK SLICE]… [--dwi IMAGES BVAL BVEC SLICE]… [-o FILE]

Fields: constant tensors, by the action of the matrices on plane waves; on tori, flat metrics in bent coordinates, whose
signature is a sum over images, and metrics that are curved, whose signature comes from trigonometric polynomials, in 3D
times a circle. Brains: a patch of a slice, its tensors interpolated to a grid four times as fine for the reference.
Errors are relative, root mean squares over the nodes; those of brains also for the nodes from the fifth off the rim on.
"""

import argparse
import sys
from collections.abc import Callable, Iterator
from itertools import product
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from scipy.ndimage import distance_transform_cdt

jax.config.update("jax_enable_x64", True)

from machine import RESULTS, timed, write  # noqa: E402

import hks_jax as hj  # noqa: E402

WAYS = ("gauss", "cancelling")
TIMES = np.array([1.5, 3.0, 6.0, 12.0])
"""In h² |T|^(1/d), h the geometric mean of the spacings and |T| the median."""
PATCH, FINER = 44, 4
DEPTH = 5
"""The distance from the rim, in nodes, from which on the rim is not felt at most times."""
LEAST = 1e-4
"""Diffusivities below this, in mm²/s, are noise, and raised to it."""
NUMBERS = (3, 10, 30)
"""Eigenvalues that are compared."""

Metric = Callable[[Any], Any]
"""From points (d,) to tensors (d, d), by JAX."""


def turned(values: list[float], *angles: float) -> np.ndarray:
    """Return the tensor of these eigenvalues, turned in one plane after the other by angles in degrees."""
    frame = np.eye(len(values))
    for axis, angle in enumerate(np.deg2rad(angles)):
        turn = np.eye(len(values))
        turn[axis : axis + 2, axis : axis + 2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        frame = frame @ turn
    return frame @ np.diag(values) @ frame.T


def bent(tensor: np.ndarray) -> Metric:
    """Return a constant metric in coordinates that are bent: isometric to it, so that its signature is known."""

    def place(x: Any) -> Any:
        waves = jnp.sin(2 * jnp.pi * (jnp.roll(x, 1) + jnp.arange(x.size) / 5))
        return x + 0.05 * waves + 0.02 * jnp.sin(2 * jnp.pi * (x + jnp.roll(x, -1)))

    def metric(x: Any) -> Any:
        jacobian = jax.jacfwd(place)(x)
        return jacobian.T @ tensor @ jacobian

    return metric


def curved(strength: float) -> Metric:
    """Return tensors of ratio 3 that turn and grow; of strength 0, a conformal metric."""

    def metric(x: Any) -> Any:
        angle = strength * (0.6 * jnp.sin(2 * jnp.pi * x[0]) + 0.5 * jnp.cos(2 * jnp.pi * x[1]))
        c, s = jnp.cos(angle), jnp.sin(angle)
        frame = jnp.array([[c, -s], [s, c]])
        values = jnp.array([1.0, 3.0]) if strength else jnp.ones(2)
        return jnp.exp(0.4 * jnp.sin(2 * jnp.pi * (x[0] + x[1]))) * (frame * values) @ frame.T

    return metric


def sampled(metric: Metric, n: int, d: int) -> np.ndarray:
    """Return the tensors at the n^d nodes of the unit torus."""
    nodes = np.stack(np.meshgrid(*[np.arange(n) / n] * d, indexing="ij"), -1)
    return np.asarray(jax.vmap(metric)(nodes.reshape(-1, d))).reshape(*(n,) * d, d, d)


def by_images(tensor: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Return the signature (n) of a flat unit torus with this metric, everywhere the same."""
    d = len(tensor)
    shifts = np.array(list(product(range(-8, 9), repeat=d)))
    squares = np.einsum("ma,ab,mb->m", shifts, tensor, shifts)
    return np.exp(-squares / (4 * times[:, None])).sum(1) * (4 * np.pi * times) ** (-d / 2)


def by_waves(metric: Metric, n: int, times: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the signature (times, n, n) and the eigenvalues of a 2D torus, from size² trigonometric polynomials."""
    tensors = sampled(metric, size, 2).reshape(-1, 2, 2)
    density = np.sqrt(np.linalg.det(tensors))
    flux = density[:, None, None] * np.linalg.inv(tensors)
    numbers = np.fft.fftfreq(size, 1 / size)
    slope = np.fft.ifft(2j * np.pi * numbers[:, None] * np.fft.fft(np.eye(size), axis=0), axis=0).real
    slopes = np.kron(slope, np.eye(size)), np.kron(np.eye(size), slope)
    matrix = sum(slopes[a].T @ (flux[:, a, b, None] * slopes[b]) for a in range(2) for b in range(2))
    root = np.sqrt(density)
    values, vectors = scipy.linalg.eigh(matrix / root / root[:, None])
    signature = np.exp(-np.outer(times, values)) @ (vectors * size / root[:, None]).T ** 2
    waves = np.exp(2j * np.pi * np.outer(np.arange(n) / n, numbers)) / size
    there = waves @ np.fft.fft2(signature.reshape(-1, size, size)) @ waves.T
    return there.real, values


def around(circumference: float, times: np.ndarray) -> np.ndarray:
    """Return the signature (n) of a circle."""
    return np.exp(-((circumference * np.arange(-99, 100)) ** 2) / (4 * times[:, None])).sum(1) / np.sqrt(
        4 * np.pi * times
    )


def at_times(tensors: np.ndarray, spacing: tuple[float, ...]) -> np.ndarray:
    """Return TIMES in the units of the metric."""
    d = tensors.shape[-1]
    return TIMES * np.median(np.linalg.det(tensors)) ** (1 / d) * np.prod(spacing) ** (2 / d)


def errors(name: str, field: hj.TensorField, boundary: str, times: np.ndarray, signature: Any) -> Iterator[dict]:
    """Compare both quadratures with the signature that is exact, for all pairs."""
    inside = field.grid.inside
    for way in WAYS:
        pencil = hj.assemble(field, boundary, quadrature=way)
        pairs = hj.eigenpairs(pencil, pencil.stiffness.size, solver="dense")
        found, said = np.asarray(hj.hks(pairs, times)), hj.truncation(pairs, times)
        relative = (found / signature - 1)[:, inside]
        inner = distance_transform_cdt(np.pad(inside, 1))[(slice(1, -1),) * inside.ndim][inside] >= DEPTH
        for t, each, estimate in zip(TIMES, relative, said.resolution_bias, strict=True):
            row = {"field": name, "nodes": field.grid.shape[0], "quadrature": way, "t": float(t)}
            row |= {"error": rms(each), "estimate": float(estimate)}
            yield row | ({"inside": rms(each[inner])} if boundary == "neumann" else {})


def rms(x: np.ndarray) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(np.square(x))))


def torus(name: str, metric: Metric, n: int, d: int, signature: Callable[[np.ndarray], np.ndarray]) -> Iterator[dict]:
    """Measure a field on the unit torus."""
    field = of_torus(metric, n, d)
    times = at_times(np.asarray(field.tensors), field.grid.spacing)
    exact = signature(times)
    yield from errors(name, field, "periodic", times, exact.reshape(len(times), *[1] * d) if exact.ndim == 1 else exact)


def of_torus(metric: Metric, n: int, d: int) -> hj.TensorField:
    """Return a field on n^d nodes of the unit torus."""
    return hj.TensorField(hj.Grid((n,) * d, 1 / n), sampled(metric, n, d))


def of_waves(name: str, tensor: np.ndarray) -> Iterator[dict]:
    """Measure a constant tensor, in the plane or in space."""
    d = len(tensor)
    n, times = {2: 64, 3: 40}[d], at_times(tensor, (1.0,) * d)
    angles = np.stack(np.meshgrid(*[2 * np.pi * np.arange(n) / n] * d), -1)
    waves = [np.cos(angles @ offset) for offset in product((-1, 0, 1), repeat=d)]
    field = hj.TensorField(hj.Grid((4,) * d), np.broadcast_to(tensor, (*(4,) * d, d, d)))
    for way in WAYS:
        pencil = hj.assemble(field, "periodic", quadrature=way)
        node = (slice(None), *(0,) * d)
        of_stiffness, of_mass = (np.tensordot(x.coefficients[node], waves, 1) for x in (pencil.stiffness, pencil.mass))
        read = 1.0 if way == "gauss" else (1 + of_mass / pencil.row_sums[0]) / 2
        found = [np.mean(np.exp(-t * of_stiffness / of_mass) * read**2 / of_mass) for t in times]
        exact = (4 * np.pi * times) ** (-d / 2)
        for t, x, y in zip(TIMES, found, exact, strict=True):
            yield {"field": name, "quadrature": way, "t": float(t), "error": abs(float(x / y - 1))}


def fields() -> Iterator[dict]:
    """Measure the fields whose signature is known."""
    yield from of_waves("2D, the identity", np.eye(2))
    yield from of_waves("2D, 4 : 1, turned by 45°", turned([1, 4], 45))
    yield from of_waves("2D, 10 : 1, turned by 30°", turned([1, 10], 30))
    yield from of_waves("3D, 3 : 2 : 1, turned", turned([1, 2, 3], 40, 60))
    for n in (24, 48):
        tensor = turned([1, 3], 30)
        yield from torus("2D, bent coordinates", bent(tensor), n, 2, lambda t: by_images(tensor, t))  # noqa: B023
        for name, strength in (("2D, conformal", 0.0), ("2D, turning and growing", 1.0)):
            metric = curved(strength)
            yield from torus(name, metric, n, 2, lambda t: by_waves(metric, n, t, 45)[0])  # noqa: B023
    tensor = turned([1, 2, 3], 40, 60)
    yield from torus("3D, bent coordinates", bent(tensor), 12, 3, lambda t: by_images(tensor, t))

    def thick(x: Any) -> Any:
        return jax.scipy.linalg.block_diag(curved(1.0)(x[:2]), jnp.full((1, 1), 1.5))

    def product(t: np.ndarray) -> np.ndarray:
        return by_waves(curved(1.0), 12, t, 45)[0][..., None] * around(1.5**0.5, t)[:, None, None, None]

    yield from torus("3D, turning and growing", thick, 12, 3, product)


def eigenvalues() -> Iterator[dict]:
    """Measure eigenvalues of metrics whose first are known."""
    for name, metric in (("2D, conformal", curved(0.0)), ("2D, turning and growing", curved(1.0))):
        known = by_waves(metric, 24, np.ones(1), 45)[1]
        for n in (24, 48):
            for way in WAYS:
                found = hj.eigenpairs(of_torus(metric, n, 2), NUMBERS[-1] + 1, "periodic", quadrature=way).eigenvalues
                for i in NUMBERS:
                    row = {"field": name, "nodes": n, "quadrature": way, "number": i}
                    yield row | {"error": abs(float(found[i] / known[i] - 1))}


def brain(name: str, plane: Any) -> Iterator[dict]:
    """Measure a patch of a slice, whose metric is D⁻¹."""
    rows, columns = (slice((n := int(np.mean(x))) - PATCH // 2, n + PATCH // 2) for x in np.nonzero(plane.mask))
    values, vectors = np.linalg.eigh(np.asarray(plane.tensors[rows, columns], np.float64))
    tensors = np.einsum("...ia,...a,...ja->...ij", vectors, 1 / np.maximum(values, LEAST), vectors)
    grid = hj.Grid((PATCH,) * 2, plane.spacing, mask=plane.mask[rows, columns], components="largest")
    domain = np.asarray(hj.assemble(hj.TensorField(grid, tensors)).space.domain)
    grid = hj.Grid(grid.shape, grid.spacing, mask=domain)
    tensors = np.where(domain[..., None, None], tensors, np.eye(2))
    times = at_times(tensors[domain], grid.spacing)
    shape = tuple(FINER * (n - 1) + 1 for n in grid.shape)
    between = np.meshgrid(*[np.arange(n) / FINER for n in shape], indexing="ij")
    low = [np.minimum(x.astype(int), n - 2) for x, n in zip(between, grid.shape, strict=True)]
    part = [x - i for x, i in zip(between, low, strict=True)]
    fine, inside = np.zeros((*shape, 2, 2)), np.zeros(shape, bool)
    corners = list(product((0, 1), repeat=2))
    for corner in corners:
        weight = np.prod([np.where(c, p, 1 - p) for c, p in zip(corner, part, strict=True)], axis=0)
        there = tuple(i + c for i, c in zip(low, corner, strict=True))
        fine += weight[..., None, None] * tensors[there]
    # A fine node may belong to several cells; one of them is enough.
    for shift in corners:
        own = [
            np.clip(np.where(p == 0, i - s, i), 0, n - 2)
            for i, p, s, n in zip(low, part, shift, grid.shape, strict=True)
        ]
        inside |= np.all([domain[tuple(i + c for i, c in zip(own, corner, strict=True))] for corner in corners], axis=0)
    refined = hj.TensorField(hj.Grid(shape, np.array(grid.spacing) / FINER, mask=inside), fine)
    exact = hj.hks_spectrum_free(refined, times, method="selected-inversion")
    exact = np.asarray(exact)[:, ::FINER, ::FINER]
    yield from errors(name, hj.TensorField(grid, tensors), "neumann", times, exact)


def seconds() -> Iterator[dict]:
    """Measure eigenpairs and signature at one time, on grids of several sizes."""
    for d, sizes, k, tensor in (
        (2, {"gauss": (48, 72, 96, 144, 192), "cancelling": (48,)}, 400, turned([1, 3], 30)),
        (3, {"gauss": (12, 18, 24), "cancelling": (12,)}, 100, turned([1, 2, 3], 40, 60)),
    ):
        coarse = of_torus(bent(tensor), sizes["gauss"][0], d)
        t = 2 * at_times(np.asarray(coarse.tensors), coarse.grid.spacing)[1:2]
        for way, those in sizes.items():
            for n in those:
                field = of_torus(bent(tensor), n, d)

                def solve() -> Any:
                    return hj.hks(hj.eigenpairs(field, k, "periodic", quadrature=way), t)  # noqa: B023

                wall, found = timed(solve, repeats=1 if d == 3 else 2)
                error = rms(np.asarray(found[0]) / by_images(tensor, t)[0] - 1)
                yield {"d": d, "quadrature": way, "nodes": n, "k": k, "error": error, "seconds": wall}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tensors", nargs=3, action="append", default=[], metavar=("TENSORS", "MASK", "SLICE"))
    parser.add_argument("--dwi", nargs=4, action="append", default=[], metavar=("IMAGES", "BVAL", "BVEC", "SLICE"))
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "quadrature.json")
    args = parser.parse_args()
    found = {"fields": list(fields()), "eigenvalues": list(eigenvalues()), "brains": []}
    for tensors, mask, index in args.tensors:
        plane = hj.io.read_tensors(tensors, mask=mask).slice("z", int(index))
        found["brains"] += brain(f"{Path(tensors).name.split('.')[0]}, z = {index}", plane)
    for images, bval, bvec, index in args.dwi:
        volume = hj.io.fit_dwi(images, bval, bvec)
        plane = volume.with_mask(hj.io.erode(volume.mask, 2)).slice("z", int(index))
        found["brains"] += brain(f"{Path(images).name.split('.')[0]}, z = {index}", plane)
    found["seconds"] = list(seconds())
    write(args.output, found)
