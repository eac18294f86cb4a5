"""Curvature of metrics whose curvature is known, its noise, and degenerate points of fields whose points are known."""

from collections.abc import Callable
from functools import cache

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

import hks_jax as hj

from .harness import Outcome

_SIDE = 3
"""Within so many nodes of a side, curvature is of third order, and of sixth inside."""


def check(seed: int) -> Outcome:
    """Try one of the kinds of question."""
    rng = np.random.default_rng(seed)
    return (_curvature, _amplification, _torus, _pair)[rng.integers(4)](rng)


def _metric(parameters: dict[str, jax.Array], x: jax.Array) -> jax.Array:
    """Pull a metric of constant curvature on the plane back by a map that is near a linear one."""

    def moved(x: jax.Array) -> jax.Array:
        waves = jnp.sin(parameters["waves"] @ x + parameters["phases"])
        return parameters["linear"] @ x + parameters["sizes"] @ waves

    y, J = moved(x), jax.jacfwd(moved)(x)
    return 4 / (1 + parameters["curvature"] * (y @ y)) ** 2 * J.T @ J


def _curvature(rng: np.random.Generator) -> Outcome:
    K, size = rng.choice([-1.0, 0.0, 1.0]) * rng.uniform(0.3, 0.9), 0.5
    parameters = {
        "curvature": K,
        "linear": 0.5 * np.eye(2) + rng.uniform(-0.15, 0.15, (2, 2)),
        "waves": rng.uniform(-2.5, 2.5, (3, 2)),
        "phases": rng.uniform(0, 6, 3),
        "sizes": rng.uniform(-0.06, 0.06, (2, 3)),
    }
    errors = []
    for n in (21, 41):
        grid = hj.Grid.from_bounds(-size, size, (n, n))
        field = hj.TensorField.from_function(jtu.Partial(_metric, jax.tree.map(jnp.asarray, parameters)), grid)
        exact = np.abs(np.asarray(hj.gaussian_curvature(field)) - K).max()
        assert exact < 1e-9, f"a function of curvature {K} has an error of {exact:.1e}"
        step = (n - 1) // 20
        nodal = np.asarray(hj.gaussian_curvature(hj.TensorField(grid, field.tensors)))[::step, ::step]
        error = np.abs(nodal - K)
        errors.append((error.max(), error[_SIDE:-_SIDE, _SIDE:-_SIDE].max()))
    for (coarse, fine), least, where in zip(
        np.transpose(errors), (2.0, 4.0), ("all nodes", "inner nodes"), strict=True
    ):
        assert fine < 1e-7 or np.log2(coarse / fine) > least, f"K = {K}, {where}: errors {coarse:.1e} and {fine:.1e}"
        assert fine < 0.1, f"K = {K}, {where}: an error of {fine:.1e}"
    return "right"


@cache
def _draws(n: int) -> Callable[[jax.Array, float, jax.Array], jax.Array]:
    def deviation(T: jax.Array, spacing: float, keys: jax.Array) -> jax.Array:
        def one(key: jax.Array) -> jax.Array:
            noise = jax.random.normal(key, (n, n, 2, 2))
            tensors = T + 1e-3 * T[0, 0] * (noise + jnp.swapaxes(noise, -1, -2)) / 2
            return hj.gaussian_curvature(hj.TensorField(hj.Grid((n, n), spacing), tensors))

        return jnp.sqrt(jnp.mean(jax.vmap(one)(keys) ** 2, axis=0))

    return jax.jit(deviation, static_argnums=1)


def _amplification(rng: np.random.Generator) -> Outcome:
    """Noise of 0.1 % of an isotropic metric gives K a noise of about 2.6 σ/h², and at most 3 times more at sides."""
    size, spacing = 10.0 ** rng.uniform(-3, 3), float(rng.choice([0.1, 1.0, 3.0]))
    keys = jax.random.split(jax.random.key(rng.integers(2**31)), 100)
    deviation = np.asarray(_draws(24)(jnp.asarray(size * np.eye(2)), spacing, keys)) * spacing**2 * size / 1e-3
    inner = deviation[6:-6, 6:-6].mean()
    assert 2.3 < inner < 2.9, f"noise of curvature inside is {inner} σ/h²"
    assert deviation.max() < 3.6 * inner, f"noise of curvature is up to {deviation.max() / inner} times that inside"
    return "right"


def _field(v: np.ndarray, grid: hj.Grid) -> hj.TensorField:
    v = v / (1 + np.abs(v))
    return hj.TensorField(grid, np.stack([np.stack([2 + v.real, v.imag], -1), np.stack([v.imag, 2 - v.real], -1)], -1))


def _torus(rng: np.random.Generator) -> Outcome:
    """Find the points of a smooth periodic field, among those of the same function on a grid eight times as fine."""
    n, fine = int(rng.integers(24, 40)), 8
    modes = rng.integers(-3, 4, (8, 2))
    factors = rng.normal(size=8) + 1j * rng.normal(size=8)
    x = np.stack(np.meshgrid(*[np.arange(n * fine) / (n * fine)] * 2, indexing="ij"), -1)
    v = np.exp(2j * np.pi * (x @ modes.T)) @ factors
    ahead = np.stack([v, np.roll(v, -1, 0), np.roll(v, (-1, -1), (0, 1)), np.roll(v, -1, 1), v])
    turns = np.rint(np.angle(ahead[1:] / ahead[:-1]).sum(axis=0) / (2 * np.pi))
    places = (np.argwhere(turns) + 0.5) / fine
    indices = turns[turns != 0] / 2
    points = hj.degenerate_points(_field(v[::fine, ::fine], hj.Grid((n, n))), periodic=True)
    assert points.indices.sum() == 0, f"indices on a torus add up to {points.indices.sum()}"

    def apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.linalg.norm((a[:, None] - b + n / 2) % n - n / 2, axis=-1)

    alone = (apart(places, places) + 1e3 * np.eye(len(places)) > 4).all(axis=1)
    assert len(points.indices) >= alone.sum(), f"{len(places)} points of {n}, found {points}"
    # Where both components nearly vanish together, a coarse grid has three points for one.
    for place, index in zip(places[alone], indices[alone], strict=True):
        near = apart(place[None], points.positions)[0] < 2
        assert points.indices[near].sum() == index, f"a point {index} at {place} of {n}: {points}"
    return "right"


def _pair(rng: np.random.Generator) -> Outcome:
    """Find two points 2 (2.5 if of the same index) to 8 cells apart, and no other."""
    same, spacing = bool(rng.random() < 0.5), tuple(rng.uniform(0.1, 2, 2))
    distance = rng.uniform(2.5 if same else 2.0, 8.0)
    x, y = np.indices((24, 24))
    middle, half = complex(*rng.uniform(8, 15, 2)), np.exp(1j * rng.uniform(0, 2 * np.pi)) * distance / 2
    z = x + 1j * y - middle
    other = z + half
    v = np.exp(1j * rng.uniform(0, 2 * np.pi)) * (z - half) * (other if same else np.conj(other)) / 100
    points = hj.degenerate_points(_field(v, hj.Grid((24, 24), spacing, (3.0, -1.0))))
    what = f"a pair at {middle}, {distance} cells apart, {'same' if same else 'opposite'}"
    assert sorted(points.indices) == [0.5 if same else -0.5, 0.5], f"{what}: {points}"
    cells = (points.positions - [3.0, -1.0]) / spacing
    true = np.array([[(middle + sign * half).real, (middle + sign * half).imag] for sign in (-1, 1)])
    error = np.linalg.norm(cells[:, None] - true, axis=-1).min(axis=0).max()
    assert error < 0.75, f"{what}: found {error} cells away"
    return "right"
