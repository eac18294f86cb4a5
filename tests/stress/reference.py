"""Eigenvalues, signatures, counts, bands and the boundary's influence, against an assembly that is not the library's.

In float64 all must agree with the reference to rounding. In float32, the bounds of docs/accuracy.md hold, or a warning
tells of it.
"""

import warnings
from itertools import product
from typing import Any

import jax.numpy as jnp
import numpy as np

import hks_jax as hj

from .harness import Outcome
from .own_assembly import Sides, Spectrum, largest, spectrum
from .problems import DOMAINS, Domain, random_form, random_problem

_RIMS = (
    Domain((17, 16), (0.1, 0.1), "mean", mask="disc"),
    Domain((22, 19), (0.1, 0.2), "mean"),
    Domain((19, 21), (1.0, 0.7), "dirichlet-rim", mask="disc"),
    Domain((18, 15), (0.1, 0.1), ("periodic", "mean")),
    Domain((20, 18), (0.1, 0.1), ("neumann", ("neumann", "dirichlet"), "dirichlet"), mask="dumbbell"),
    Domain((9, 8, 9), (0.1, 0.1, 0.1), "mean", mask="disc"),
    Domain((7, 6, 7), (0.1, 0.2, 0.1), "dirichlet-rim", mask="disc"),
)
_LARGE = (
    Domain((46, 40), (0.1, 0.1)),
    Domain((45, 41), (0.1, 0.1), ("periodic", "dirichlet")),
    Domain((13, 12, 13), (0.1, 0.1, 0.1)),
)
_ALL = (*DOMAINS, *_RIMS, *_RIMS, *_LARGE)
_EXACT, _SINGLE = (1e-11, 0.0, 1e-8, 1e-7), (6e-8, 1e-5, 1e-3, 1e-4)
"""In float64 and float32: errors of eigenvalues relative to λ_max and to themselves, of signatures relative to their
greatest value, and the least gap, relative to λ_max, at which the k lowest pairs can be told from the others."""


def check(seed: int) -> Outcome:
    """Compare a random problem, with random fields and rules, with the reference."""
    rng = np.random.default_rng(seed)
    problem = random_problem(seed, _ALL)
    domain, grid = problem.domain, problem.field.grid
    single = rng.random() < 0.3
    tensors = np.asarray(problem.field.tensors).astype(np.float32 if single else np.float64)
    form, name = random_form(rng, domain, tensors)
    inside = np.ones(grid.shape, bool) if grid.mask is None else np.asarray(grid.mask)
    problems, k = _problems(domain.boundary, grid.dimension), int(rng.choice([9, 30]))
    parts = [spectrum(tensors, domain.spacing, inside, sides, rim, form, k + 12) for sides, rim in problems]
    exact, top = _merged(parts), max(largest(part, tensors, domain.spacing, form.fick) for part in parts)
    k = min(k, len(exact.values) - 1)
    what = f"{problem}, {name}, k = {k}, {tensors.dtype}"
    interpolation = "log-euclidean" if form.logarithms else "linear"
    field = hj.TensorField(grid, jnp.asarray(tensors), interpolation)
    if form.fick:
        field = hj.TensorField.from_diffusion(grid, jnp.asarray(tensors), operator="fick", interpolation=interpolation)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        pencil = hj.assemble(
            field,
            domain.boundary,
            "lumped" if form.lumped else "consistent",
            quadrature="cancelling" if form.cancelling else "gauss",
            potential=form.potential,
            density=form.density,
        )
        pairs = hj.eigenpairs(pencil, k, solver=str(rng.choice(["auto", "dense"])), multiplet="complete")
    told = any(word in str(w.message) for w in said for word in ("did not converge", "confirm", "float32"))
    of_top, relative, of_signature, least_gap = _SINGLE if single else _EXACT
    error = np.abs(np.asarray(pairs.eigenvalues, float) - exact.values[: pairs.k])
    if (error > of_top * top + relative * np.abs(exact.values[: pairs.k])).any():
        assert told, f"{what}: eigenvalues are off by {error.max() / top:.1e} λ_max"
        return "told"
    kept = int(np.asarray(pairs.kept).sum())
    ends = exact.values[max(kept - 1, 0)], exact.values[kept] if kept < len(exact.values) else np.inf
    span = ends[0] - exact.values[0]
    if not kept or ends[1] - ends[0] < least_gap * top or span < 1e-6 * top:
        return "right"
    times = np.array([2.0, 5.0, 20.0]) / max(span, abs(exact.values[0]) / 3)
    flat = bool(rng.random() < 0.5)
    root = np.sqrt(np.linalg.det(tensors.astype(float))) if form.fick else 1.0
    expected = _signature(exact, times, kept) * (
        ((4 * np.pi * times) ** (grid.dimension / 2)).reshape(-1, *[1] * grid.dimension) * root if flat else 1
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", hj.AccuracyWarning)
        signature = hj.hks(pairs, times, "flat" if flat else "raw")
        _same(signature, expected, of_signature, f"{what}: signature")
        if len(parts) == 2 and "mean" in str(domain.boundary) and not single:
            lowest = [_signature(part, times, int(np.sum(part.values <= ends[0]))) for part in parts]
            share = np.clip((lowest[0] - lowest[1]) / (lowest[0] + lowest[1]), 0, 1)
            seen = lowest[0] + lowest[1] > 1e-3 * np.nanmax(lowest[0])
            influence = np.asarray(hj.boundary_influence(pairs, times))
            _same(np.where(seen, influence, 0), np.where(seen, share, 0), 1e-4, f"{what}: influence")
        if not single and rng.random() < 0.5:
            _check_band(rng, pairs, exact, top, what)
    return "told" if told else "right"


def _check_band(rng: np.random.Generator, pairs: Any, exact: Spectrum, top: float, what: str) -> None:
    """Compare the share of all eigenpairs between two random places in gaps of the spectrum."""
    kept = int(np.asarray(pairs.kept).sum())
    gaps = [0, *(1 + np.flatnonzero(np.diff(exact.values[:kept]) > 1e-6 * top))]
    low, high = sorted(rng.choice(gaps, 2, replace=False)) if len(gaps) > 1 else (0, 0)
    if low == high:
        return
    a, b = (exact.values[0] - 1e-3 * top if i == 0 else exact.values[i - 1 : i + 1].mean() for i in (low, high))
    inside = Spectrum(exact.values[low:high], exact.squares[low:high])
    what = f"{what}: band {a}, {b}"
    found = int(hj.count_eigenvalues(pairs.pencil, b)) - int(hj.count_eigenvalues(pairs.pencil, a))
    assert found == high - low, f"{what} has {high - low}, counted {found}"
    times = np.array([1.0, 3.0]) / max(abs(inside.values).max(), 1e-9 * top)
    band = hj.spectral_signature(pairs, lambda t, x: jnp.where((x >= a) & (x < b), jnp.exp(-t * x), 0), times)
    _same(band, _signature(inside, times, high - low), 1e-7, f"{what}: signature")


def _same(found: Any, expected: np.ndarray, tolerance: float, what: str) -> None:
    assert (np.isnan(found) == np.isnan(expected)).all(), f"{what}: NaN elsewhere"
    error = np.nanmax(np.abs(np.asarray(found) - expected)) / np.nanmax(np.abs(expected))
    assert error <= tolerance, f"{what} is off by {error:.1e}"


def _signature(spectrum: Spectrum, times: np.ndarray, k: int) -> np.ndarray:
    return np.tensordot(np.exp(-np.outer(times, spectrum.values[:k])), spectrum.squares[:k], 1)


def _merged(parts: list[Spectrum]) -> Spectrum:
    """Return the spectrum of the doubled domain, whose functions are spread over as many copies as there are parts."""
    values = np.concatenate([part.values for part in parts])
    order = np.argsort(values, kind="stable")
    return Spectrum(values[order], np.concatenate([part.squares for part in parts])[order] / len(parts))


def _problems(boundary: Any, d: int) -> list[tuple[Sides, str]]:
    """Return the problems, conditions on sides and on the rim, that a boundary stands for."""
    names = {"mean": ("mean",) * (d + 1), "dirichlet-rim": ("dirichlet",) * (d + 1)}
    entries = names.get(boundary, (boundary,) * d) if isinstance(boundary, str) else boundary
    sides = [each if isinstance(each, tuple) else (each, each) for each in entries]
    rim = sides.pop()[0] if len(sides) > d else "mean" if ("mean", "mean") in sides else "neumann"
    both = ("neumann", "dirichlet")
    found = []
    for mean in both if "mean" in str(boundary) else ("",):
        choices = [both if "mirror" in pair else [None] for pair in sides]
        for mirrored in product(*choices):
            conditions = [
                (each, each) if each else tuple(mean if side == "mean" else side for side in pair)
                for each, pair in zip(mirrored, sides, strict=True)
            ]
            found.append((tuple(conditions), mean if rim == "mean" else rim))
    return found
