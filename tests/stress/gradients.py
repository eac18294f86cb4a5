"""Derivatives of signatures against differences of the dense solver's values.

A seed picks one of the configurations, which share their compilations, and the field, the direction and the weights.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import hks_jax as hj

from .harness import Outcome

_SPARE = 8
"""Pairs beyond k that the reference has, so that it can follow a truncation that was completed."""


@dataclass(frozen=True)
class Configuration:
    """What is compiled once: everything but the numbers in the arrays. Without a shape it is a sphere's mesh."""

    solver: Any
    k: int
    shape: tuple[int, ...] = ()
    boundary: Any = "neumann"
    mass: str = "consistent"
    signature: str = "hks"
    mode: str = "jit"  # "eager", "jit" and "vmap" of grad; "jvp"
    by: str = "domain"  # the tensors or vertices, or the "times"
    dtype: str = "float64"
    multiplet: str = "drop"
    mask: str = ""

    @property
    def grid(self) -> hj.Grid:
        """The grid of a configuration that has one."""
        spacing = tuple(0.1 * (1 + 0.3 * a) for a in range(len(self.shape)))
        inside = np.ones(self.shape, bool)
        if self.mask == "hole":
            inside[:3, :4] = False
            inside[-4, -5] = False
        elif self.mask == "islands":  # four equal ones
            inside[self.shape[0] // 2] = inside[:, self.shape[1] // 2] = False
        return hj.Grid(self.shape, spacing, mask=inside if self.mask else None, components="all")


_FILTER, _LANCZOS = hj.ChebyshevFilter(block=4), hj.BlockLanczos(block=4)
CONFIGURATIONS = [
    Configuration("shift-invert", 12, (12, 11)),
    Configuration("shift-invert", 9, (12, 12), "dirichlet", "lumped", "wks"),
    Configuration("shift-invert", 17, (10, 14), "periodic", signature="heat kernel", multiplet="complete"),
    Configuration("shift-invert", 14, (11, 10), ("mirror", "neumann"), signature="diffusion distance"),
    Configuration("shift-invert", 10, (12, 12), mask="hole", signature="scale-invariant", mode="jvp"),
    Configuration("shift-invert", 12, (13, 13), mask="islands", multiplet="complete"),
    Configuration("shift-invert", 11, (12, 10), dtype="float32", mode="jvp"),
    Configuration("shift-invert", 13, (10, 12), "dirichlet", signature="biharmonic distance", mode="eager"),
    Configuration("shift-invert", 8, (12, 11), ("periodic", ("neumann", "dirichlet")), "lumped", mode="vmap"),
    Configuration("shift-invert", 12, (6, 5, 6), signature="heat trace"),
    Configuration("shift-invert", 10, (5, 6, 6), "periodic", "lumped", "wks", multiplet="complete"),
    Configuration("shift-invert", 12, (11, 12), signature="wks", by="times", mode="jvp"),
    Configuration("dense", 20, (10, 10), signature="diffusion distance", mode="vmap"),
    Configuration("dense", 12, (9, 11), "mirror", "lumped", "scale-invariant", dtype="float32"),
    Configuration("dense", 15, (5, 5, 5), ("neumann", "dirichlet", "periodic"), multiplet="complete", mode="jvp"),
    Configuration("dense", 16, (10, 11), signature="scale-invariant", by="times"),
    Configuration(_FILTER, 8, (15, 16)),
    Configuration(_FILTER, 7, (16, 16), "periodic", "lumped", mode="jvp", multiplet="complete"),
    Configuration(_FILTER, 9, (7, 7, 7), ("neumann", "dirichlet", "neumann"), signature="heat kernel"),
    Configuration(_FILTER, 6, (16, 15), "periodic", "lumped", dtype="float32", mode="eager"),
    Configuration(_LANCZOS, 12, (16, 15), mode="jvp"),
    Configuration(_LANCZOS, 10, (15, 17), ("dirichlet", "periodic"), "lumped", "wks"),
    Configuration("shift-invert", 10, signature="hks"),
    Configuration("shift-invert", 13, signature="wks", mode="jvp", multiplet="complete"),
    Configuration("dense", 9, signature="biharmonic distance", mode="eager"),
]


def check(seed: int) -> Outcome:
    """Compare one directional derivative with differences."""
    rng = np.random.default_rng(seed)
    number = int(rng.integers(len(CONFIGURATIONS)))
    configuration = CONFIGURATIONS[number]
    dtype = np.dtype(configuration.dtype)
    points, kind = _points(configuration, rng)
    points = points.astype(dtype)
    where = f"configuration {number} ({configuration}), {kind}"
    exact = points.astype(np.float64)
    values = np.asarray(_spectrum(configuration, exact))
    k = configuration.k
    positive = values[values > 1e-9 * values[-1]]
    times = np.geomspace(2 / values[k - 1], 2 / positive[0], 8 if configuration.signature == "scale-invariant" else 2)
    times = times.astype(dtype)
    if configuration.by == "times":
        base, other = times, points
        direction = times * rng.uniform(-0.3, 0.3, times.shape)
    else:
        base, other = points, times
        direction = points if rng.random() < 0.25 else _direction(configuration, points, rng)
    direction = direction.astype(dtype)

    shape = jax.eval_shape(partial(_signature, configuration, dense=True), base, other, k).shape
    weights = rng.standard_normal(shape)
    known = np.isfinite(_reference(configuration, base.astype(np.float64), other.astype(np.float64), k, 1.0))
    weights = np.where(known, weights, 0.0)

    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            kept, slopes = _derivative(configuration)(base, other, direction, weights.astype(dtype))
            kept, slopes = int(kept), np.asarray(slopes, np.float64)
    except ValueError:
        return "refused"
    told = any(issubclass(w.category, hj.AccuracyWarning) for w in caught)

    # The derivative of a truncated spectrum exists as far as there is a gap where it ends.
    following = values[kept] if kept < values.size else np.inf
    gap = (following - values[kept - 1]) / max(following, 1e-300)
    if gap < (1e-2 if configuration.dtype == "float32" else 1e-4):
        return "told"
    slope, error, size = _differences(configuration, exact_of(base), exact_of(other), direction, weights, kept, gap)
    tolerance = (1e-3 + 3e-4 / gap) if configuration.dtype == "float32" else 1e-6 + 1e-8 / gap
    if not np.isfinite(slope) or error > 1e-2 * size:
        return "told"  # the differences themselves say nothing
    assert np.isfinite(slopes).all(), f"{where}: {slopes}, by differences {slope} ({'told' if told else 'silent'})"
    bound = tolerance * size + 10 * error
    assert np.all(np.abs(slopes - slope) <= bound), f"{where}: {slopes}, by differences {slope} ± {bound:.1e}"
    return "right"


def exact_of(array: np.ndarray) -> np.ndarray:
    """Return the same numbers in double precision."""
    return array.astype(np.float64)


def _points(configuration: Configuration, rng: np.random.Generator) -> tuple[np.ndarray, str]:
    """Return tensors (*shape, d, d) or vertices, and what they are like."""
    kinds = ["smooth", "rough", "symmetric", "noise 1e-6", "noise 1e-9"]
    kind, scale = str(rng.choice(kinds)), float(rng.choice([1e-6, 1.0, 1.0, 1e6]))
    amount = {"smooth": 0.3, "rough": 0.3, "symmetric": 0.0, "noise 1e-6": 1e-6, "noise 1e-9": 1e-9}[kind]
    if not configuration.shape:
        vertices, _ = sphere()
        moved = rng.standard_normal(vertices.shape)
        if kind == "smooth":
            moved = np.sin(2 * vertices @ rng.standard_normal((3, 3)) + rng.uniform(0, 6, 3))
        return np.sqrt(scale) * (vertices + 0.3 * amount * moved), f"{kind}, scale {scale}"
    d, shape = len(configuration.shape), configuration.shape
    noise = rng.standard_normal((*shape, d, d))
    if kind == "smooth":
        x = configuration.grid.nodes
        waves = np.sin(x @ rng.uniform(1, 4, (d, d * d)) + rng.uniform(0, 6, d * d))
        noise = waves.reshape(*shape, d, d)
    factor = np.eye(d) + amount * noise
    return scale * np.einsum("...ki,...kj->...ij", factor, factor), f"{kind}, scale {scale}"


def _direction(configuration: Configuration, points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    noise = rng.standard_normal(points.shape)
    if configuration.shape:
        noise = (noise + np.swapaxes(noise, -1, -2)) / 2
    return 0.05 * np.abs(points).max() * noise


@cache
def sphere(levels: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and faces of an octahedron, refined and blown up to the unit sphere."""
    vertices = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float)
    faces = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])
    for _ in range(levels):
        edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        unique, inverse = np.unique(edges, axis=0, return_inverse=True)
        ab, bc, ca = (len(vertices) + inverse.reshape(-1, 3)).T
        a, b, c = faces.T
        faces = np.concatenate([np.stack(t, axis=1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
        vertices = np.concatenate([vertices, vertices[unique].mean(axis=1)])
        vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
    return vertices, faces


def _domain(configuration: Configuration, points: Any) -> Any:
    if configuration.shape:
        return hj.TensorField(configuration.grid, points)
    return hj.SurfaceMesh(points, sphere()[1])


def _pairs(configuration: Configuration, points: Any, dense: bool) -> Any:
    c, domain = configuration, _domain(configuration, points)
    if dense:
        return hj.eigenpairs(domain, c.k + _SPARE, c.boundary, "dense", c.mass)
    return hj.eigenpairs(domain, c.k, c.boundary, c.solver, c.mass, c.multiplet)


def _signature(configuration: Configuration, base: Any, other: Any, kept: Any, dense: bool) -> Any:
    return _with_pairs(configuration, base, other, kept, dense)[0]


def _with_pairs(configuration: Configuration, base: Any, other: Any, kept: Any, dense: bool) -> tuple[Any, Any]:
    """Return the signature and its pairs; the dense solver's are as many as ``kept``."""
    points, times = (other, base) if configuration.by == "times" else (base, other)
    pairs = _pairs(configuration, points, dense)
    if dense:
        pairs = pairs.keeping(jnp.arange(pairs.k) < kept)
    centre = tuple(n // 3 for n in configuration.shape) if configuration.shape else 5
    functions: dict[str, Callable[[], Any]] = {
        "hks": lambda: hj.hks(pairs, times),
        "wks": lambda: hj.wks(pairs, -jnp.log(times / 2), 0.5),
        "heat kernel": lambda: hj.heat_kernel(pairs, times, centre),
        "heat trace": lambda: hj.heat_trace(pairs, times),
        "diffusion distance": lambda: hj.diffusion_distance(pairs, times, centre),
        "biharmonic distance": lambda: hj.biharmonic_distance(pairs, centre),
        "scale-invariant": lambda: hj.scale_invariant_hks(pairs, 3, times=times),
    }
    return functions[configuration.signature](), pairs


@cache
def _compiled_spectrum(configuration: Configuration) -> Callable:
    return jax.jit(lambda points: _pairs(configuration, points, True).eigenvalues)


def _spectrum(configuration: Configuration, points: np.ndarray) -> Any:
    return _compiled_spectrum(configuration)(points)


@cache
def _compiled_reference(configuration: Configuration) -> Callable:
    return jax.jit(partial(_signature, configuration, dense=True))


def _reference(configuration: Configuration, base: Any, other: Any, kept: int, weights: Any) -> np.ndarray:
    return np.asarray(_compiled_reference(configuration)(base, other, kept)) * weights


@cache
def _derivative(configuration: Configuration) -> Callable:
    """Return the function to how many pairs are kept and directional derivatives, by one mode or both."""

    def loss(base: Any, other: Any, weights: Any) -> tuple[Any, Any]:
        signature, pairs = _with_pairs(configuration, base, other, None, False)
        counted = weights != 0
        return jnp.sum(jnp.where(counted, weights * signature, 0)), pairs.kept.sum()

    def by_reverse(base: Any, other: Any, direction: Any, weights: Any) -> tuple[Any, Any]:
        gradient, kept = jax.grad(loss, has_aux=True)(base, other, weights)
        return kept, jnp.vdot(gradient, direction)[None]

    def by_both(base: Any, other: Any, direction: Any, weights: Any) -> tuple[Any, Any]:
        kept, reverse = by_reverse(base, other, direction, weights)
        forward = jax.jvp(lambda x: loss(x, other, weights)[0], (base,), (direction,))[1]
        return kept, jnp.append(reverse, forward)

    def by_batch(base: Any, other: Any, direction: Any, weights: Any) -> tuple[Any, Any]:
        # The second of the batch is another problem: what it needs must not change the first.
        kept, slopes = jax.vmap(partial(by_reverse, other=other, direction=direction, weights=weights))(
            jnp.stack([base, base + direction])
        )
        return kept[0], slopes[0]

    modes = {"eager": by_reverse, "jit": by_reverse, "vmap": by_batch, "jvp": by_both}
    chosen = modes[configuration.mode]
    return chosen if configuration.mode == "eager" else jax.jit(chosen)


def _differences(
    configuration: Configuration,
    base: np.ndarray,
    other: np.ndarray,
    direction: np.ndarray,
    weights: np.ndarray,
    kept: int,
    gap: float,
) -> tuple[float, float, float]:
    """Return the directional derivative, an estimate of its error, and the sum of its terms' sizes."""

    def value(h: float) -> np.ndarray:
        return np.where(weights == 0, 0, _reference(configuration, base + h * direction, other, kept, weights))

    def central(h: float) -> np.ndarray:
        return (value(h) - value(-h)) / (2 * h)

    step = min(8e-3, gap / 20)
    coarse, fine, finest = (central(step / 2**i) for i in range(3))
    once = (4 * fine - coarse) / 3, (4 * finest - fine) / 3
    twice = (16 * once[1] - once[0]) / 15
    return float(twice.sum()), float(abs(np.sum(once[1] - twice))), float(np.abs(twice).sum())
