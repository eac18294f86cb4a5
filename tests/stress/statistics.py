"""Error bars that are honest: scores on noise alone, discoveries, and how often intervals contain the truth.

A check measures one field many times, with independent noise. Nodes of one map are correlated, so that shares are
compared with bounds of a few effective nodes for each map. Bounds hold at more than four standard deviations.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import hks_jax as hj

from .harness import Outcome

_TIMES = np.array([2.0, 6.0, 20.0])
_MEASUREMENTS = 24
_EFFECTIVE = 3
"""Of the nodes of a map, how many count as independent."""
_DOMAINS = {
    "torus": (hj.Grid((10, 9)), "periodic"),
    "square": (hj.Grid((9, 9)), "neumann"),
    "disc": (hj.Grid((12, 11), mask=np.hypot(*(np.indices((12, 11)).T - [5.5, 5.0]).T) < 5.3), "mean"),
}

_SETTINGS = (("torus", "inverse", 8), ("torus", "inverse", 32), ("square", "tensor", 8), ("disc", "fick", 8))


def check(seed: int) -> Outcome:
    """Measure noise alone, or a smooth field, on a random domain."""
    rng = np.random.default_rng(seed)
    domain, operator, draws = _SETTINGS[rng.integers(len(_SETTINGS))]
    level = float(rng.choice([0.02, 0.05, 0.1]))
    alone = rng.random() < 0.5
    x = np.indices(_DOMAINS[domain][0].shape) * rng.uniform(0.2, 0.6)
    waves = [0 if alone else 0.3 * np.sin(x[0] * a + x[1] * b + c) for a, b, c in rng.normal(size=(3, 3))]
    constant = np.diag(rng.uniform(0.5, 1.5, 2)) + rng.uniform(-0.3, 0.3) * (1 - np.eye(2))
    D = np.exp(waves[0])[..., None, None] * constant + np.zeros((*x.shape[1:], 2, 2))
    D[..., 0, 0] *= np.exp(waves[1])
    D[..., 1, 1] *= np.exp(waves[2])
    found = _measured(domain, operator, draws)(jnp.asarray(D), level, 1000 * seed)
    what = f"{domain}, {operator}, {draws} draws, noise {level}{', alone' if alone else ''}"
    trusted = jax.tree.map(lambda each: np.asarray(each).mean(axis=0) > 0.5, found["trusted"])
    for name in ("map", "trace"):
        believed, size = trusted[name], _MEASUREMENTS * (_EFFECTIVE if name == "map" else 1)
        inside = np.asarray(found["inside"][name]).mean(axis=0)
        low = 0.95 - 5.5 * np.sqrt(0.95 * 0.05 / size)
        assert (inside[believed] > low).all(), f"{what}: 95 % intervals of the {name} contain {inside}"
        ratio = np.asarray(found["variance"][name]).mean(axis=0) / np.asarray(found["error"][name]).mean(axis=0)
        assert ((ratio > 0.3) & (ratio < 4))[believed].all(), f"{what}: variances of the {name} are {ratio} of the true"
    if alone:
        beyond, declared = (np.asarray(found[name]).mean(axis=0) for name in ("beyond", "declared"))
        high = 0.046 + 5.5 * np.sqrt(0.046 * 0.954 / (_MEASUREMENTS * _EFFECTIVE))
        assert (beyond[trusted["map"]] < high).all(), f"{what}: |z| > 2 on {beyond} of the nodes"
        assert beyond.mean() > 0.001, f"{what}: |z| > 2 on {beyond} of the nodes"
        assert (declared * _MEASUREMENTS <= 8).all(), f"{what}: discoveries on {declared} of maps of noise alone"
    return "right" if all(each.all() for each in trusted.values()) else "told"


@cache
def _measured(domain: str, operator: str, draws: int) -> Callable[..., dict[str, Any]]:
    """Return a compiled function that measures tensors with noise many times; its results have a row for each."""
    grid, boundary = _DOMAINS[domain]
    inside = jnp.asarray(grid.inside)

    def signature(D: jax.Array) -> dict[str, jax.Array]:
        choice = {"operator": "fick"} if operator == "fick" else {"metric": operator}
        pairs = hj.eigenpairs(hj.TensorField.from_diffusion(grid, D, **choice), 40, boundary, solver="dense")
        return {"map": hj.hks(pairs, _TIMES, "flat"), "trace": hj.heat_trace(pairs, _TIMES)}

    @jax.jit
    def measure(D: jax.Array, level: jax.Array, first: jax.Array) -> dict[str, Any]:
        truth = signature(D)
        relative = hj.TensorNoise.relative(D, 1.0, grid).covariance

        def one(seed: jax.Array) -> dict[str, Any]:
            noise = hj.TensorNoise(relative * level**2, grid)
            measured = D + noise.tensors(jax.random.normal(jax.random.key(seed + 1_000_000), noise.white_shape))
            own = hj.TensorNoise(hj.TensorNoise.relative(measured, 1.0, grid).covariance * level**2, grid)
            bars = hj.uncertainty(signature, measured, own, method="resample", draws=draws, seed=seed)
            low, high = bars.interval(0.95)

            def mean(values: jax.Array) -> jax.Array:
                return values if values.ndim == 1 else jnp.mean(values, axis=(1, 2), where=inside)

            return {
                "beyond": mean(jnp.abs(bars.z()["map"]) > 2),
                "declared": jnp.any(bars.discoveries()["map"] & inside, axis=(1, 2)),
                "inside": jax.tree.map(lambda a, x, b: mean((a <= x) & (x <= b)), low, truth, high),
                "variance": jax.tree.map(lambda s: mean(s**2), bars.deviation),
                "error": jax.tree.map(lambda x, y, b: mean((x - y - b) ** 2), bars.value, truth, bars.bias),
                "trusted": bars.trusted,
            }

        return jax.lax.map(one, first + jnp.arange(_MEASUREMENTS))

    return measure
