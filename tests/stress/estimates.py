"""Estimated errors against errors: `truncation` against biquadratic elements, `truncation_map` against all pairs.

The reference for the discretisation is an assembly of its own, of degree two on the same cells, with the metric taken
from a function instead of from the nodes. No estimate is a bound: a check fails where an error is many times as large.
"""

import warnings
from collections.abc import Callable
from functools import reduce
from itertools import product

import numpy as np
import scipy.linalg

import hks_jax as hj

from .harness import Outcome

_CELLS = 12
_OPTIMISTIC = 10.0
"""By how much an error above 1 % may exceed its estimate."""
_BOUNDARIES = ("neumann", "dirichlet", "periodic", "mean")
_FORMS = (("gauss", "consistent"), ("gauss", "lumped"), ("cancelling", "consistent"))


def check(seed: int) -> Outcome:
    """Compare estimates with the errors of a random smooth field's signature."""
    rng = np.random.default_rng(seed)
    boundary, (quadrature, mass) = _BOUNDARIES[rng.integers(4)], _FORMS[rng.integers(3)]
    kind, metric = _metric(rng, boundary == "periodic")
    n = _CELLS + (boundary != "periodic")
    grid = hj.Grid((n, n), 1 / _CELLS)
    tensors = metric(grid.nodes)
    times = np.array([3.0, 6.0, 15.0, 50.0]) * np.sqrt(np.median(np.linalg.det(tensors))) / _CELLS**2
    what = f"{kind}, {boundary}, {quadrature}, {mass}"
    pencil = hj.assemble(hj.TensorField(grid, tensors), boundary, mass, quadrature=quadrature)
    inner = (slice(1, -1),) * 2 if boundary == "dirichlet" else (slice(None),) * 2
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", hj.AccuracyWarning)
        whole = hj.eigenpairs(pencil, sum(part.space.n_dof for part in pencil.parts), solver="dense")
        few = hj.eigenpairs(pencil, 20, solver="dense")
        early = np.array([2.0, 4.6]) / float(few.next_eigenvalue)
        signature = np.asarray(hj.hks(whole, times))[:, *inner]
        missing = np.asarray(1 - hj.hks(few, early) / hj.hks(whole, early))[:, *inner].max(axis=(1, 2))
    exact = _signature(metric, boundary, times)[:, *inner]
    _compare(np.median(np.abs(signature / exact - 1), axis=(1, 2)), hj.truncation(whole, times).resolution_bias, what)
    _compare(missing, np.nanmax(hj.truncation_map(few, early), axis=(1, 2)), f"truncation, {what}")
    return "right"


def _compare(error: np.ndarray, estimate: np.ndarray, what: str) -> None:
    estimate = np.asarray(estimate)
    low = (error > 0.01) & (estimate < 0.5) & (error > _OPTIMISTIC * estimate)
    assert not low.any(), f"{what}: errors {error}, estimated {estimate}"


def _metric(rng: np.random.Generator, periodic: bool) -> tuple[str, Callable[[np.ndarray], np.ndarray]]:
    """Return the name of a kind of field, and a function of positions in the unit square."""
    kind = str(rng.choice(["bump", "turning", "anisotropic"]))
    wave = 2 * np.pi * rng.integers(-1, 2, 2) if periodic else rng.normal(size=2, scale=3)
    phase, size, centre = rng.uniform(0, 6), rng.uniform(0.2, 1.0), rng.uniform(0.3, 0.7, 2)
    ratio = {"bump": 1.0, "turning": rng.choice([2.0, 5.0]), "anisotropic": 10 ** rng.uniform(0.5, 4)}[kind]

    def metric(x: np.ndarray) -> np.ndarray:
        angle = size * np.sin(x @ wave + phase) if kind == "turning" else np.full(x.shape[:-1], phase)
        axis = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        tensors = np.eye(2) + (ratio - 1) * axis[..., :, None] * axis[..., None, :]
        factor = (
            np.exp(2 * size * np.exp(-20 * np.sum((x - centre) ** 2, axis=-1))) if kind == "bump" else 1 + 0 * angle
        )
        return factor[..., None, None] * tensors

    return kind, metric


def _signature(metric: Callable[[np.ndarray], np.ndarray], boundary: str, times: np.ndarray) -> np.ndarray:
    """Return the signature at the nodes, by biquadratic elements on the grid's cells."""
    points, weights = np.polynomial.legendre.leggauss(4)
    x = (points + 1) / 2
    values = np.stack([2 * (x - 0.5) * (x - 1), 4 * x * (1 - x), 2 * x * (x - 0.5)], axis=1)
    slopes = np.stack([4 * x - 3, 4 - 8 * x, 4 * x - 1], axis=1) * _CELLS
    shapes = np.kron(values, values)
    gradients = np.stack([np.kron(slopes, values), np.kron(values, slopes)], axis=-1)
    areas = np.kron(weights, weights) / (2 * _CELLS) ** 2
    cells = np.array(list(product(range(_CELLS), repeat=2)))
    tensors = metric((cells[:, None] + np.array(list(product(x, x)))) / _CELLS)
    density = np.sqrt(np.linalg.det(tensors)) * areas
    K = np.einsum("qia,eqab,qjb,eq->eij", gradients, np.linalg.inv(tensors), gradients, density, optimize=True)
    M = np.einsum("qi,eq,qj->eij", shapes, density, shapes, optimize=True)
    n = 2 * _CELLS + (boundary != "periodic")
    nodes = (2 * cells[:, None] + np.array(list(product(range(3), repeat=2)))) % n
    numbers = nodes[..., 0] * n + nodes[..., 1]
    matrices = np.zeros((2, n * n, n * n))
    for total, each in zip(matrices, (K, M), strict=True):
        np.add.at(total, (numbers[:, :, None], numbers[:, None, :]), each)
    side = np.isin(np.arange(n), [0, n - 1])
    outer = reduce(np.logical_or.outer, [side, side]).ravel()
    conditions = {"dirichlet": [~outer], "mean": [~outer, np.full(n * n, True)]}.get(boundary, [np.full(n * n, True)])
    signature = np.zeros((len(times), n * n))
    for free in conditions:
        values, vectors = scipy.linalg.eigh(*matrices[:, free][:, :, free])
        signature[:, free] += np.exp(-np.outer(times, values)) @ vectors.T**2 / len(conditions)
    return signature.reshape(-1, n, n)[:, ::2, ::2]
