"""Fits to targets: of a metric of the parametrisation they recover it, and what they cannot explain they tell.

A check fits on a small grid, with all eigenpairs. The target is the signature of a metric within the parametrisation,
or of one beyond it.
"""

import warnings

import jax.numpy as jnp
import numpy as np

import hks_jax as hj
from hks_jax.domain import spd
from hks_jax.inverse import Search

from .harness import Outcome

_GRID = hj.Grid((8, 7), (1 / 7, 1 / 6))
_PAIRS, _TIMES = 56, np.geomspace(0.03, 0.3, 4)
_WITHIN = {"conformal": 1e-3, "eigenvalues": 0.03, "rotation": 0.03, "log-euclidean": 0.1}
"""How far from the true tensors a fit may end that says nothing: the fewer unknowns, the better they are determined.
Signatures hardly determine the tensors at corners, so that medians over the nodes are compared."""


def check(seed: int) -> Outcome:
    """Fit to the signature of a metric that the parametrisation has, or not."""
    rng = np.random.default_rng(seed)
    kind, beyond = str(rng.choice(list(_WITHIN))), bool(rng.random() < 0.3)
    x, y = np.moveaxis(_GRID.nodes, -1, 0)
    a, b, c = (rng.uniform(0.1, 0.3) * np.sin(x * p + y * q + r) for p, q, r in rng.normal(size=(3, 3), scale=2))
    flat = np.diag(rng.uniform(0.7, 1.4, 2)) + np.zeros((*_GRID.shape, 2, 2))
    if beyond:
        kind = "conformal"
        true = _exp(np.log(flat[0, 0, 0, 0]) + 2 * a, np.log(flat[0, 0, 1, 1]) - 2 * b, 2 * c)
    elif kind == "conformal":
        true = np.exp(a)[..., None, None] * flat
    elif kind == "eigenvalues":
        true = np.exp(np.stack([a, b], -1))[..., None] * flat
    elif kind == "rotation":
        turn = np.stack([np.stack([np.cos(a), -np.sin(a)], -1), np.stack([np.sin(a), np.cos(a)], -1)], -2)
        flat = np.diag([1.6, 0.7]) + np.zeros_like(flat)
        true = turn @ flat @ np.swapaxes(turn, -1, -2)
    else:
        true = _exp(np.log(flat[..., 0, 0]) + a, np.log(flat[..., 1, 1]) + b, c)
    what = f"{kind}{', target beyond it' if beyond else ''}"
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        target = hj.hks(hj.eigenpairs(hj.TensorField(_GRID, true), _PAIRS, solver="dense"), _TIMES)
        fit = hj.fit_metric(
            hj.TensorField(_GRID, flat), target, _TIMES, kind, k=_PAIRS, search=Search(max_steps=25), solver="dense"
        )
        off = float(np.max(np.abs(fit.hks / target - 1)))
    told = not fit.converged or any(str(w.message).startswith(("target", "k:")) for w in said)
    size = np.linalg.norm(true, axis=(-2, -1))
    error = float(np.median(np.linalg.norm(fit.field.tensors - true, axis=(-2, -1)) / size))
    assert told or not beyond, (
        f"{what}: {fit.result} without a word, tensors off by {error:.1e}, signature by {off:.1e}"
    )
    if told:
        return "told"
    assert off < 0.01, f"{what}: {fit.result} without a word, signature off by {off:.1e}"
    assert error < _WITHIN[kind], f"{what}: {fit.result} without a word, tensors off by {error:.1e}"
    return "right"


def _exp(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    return np.asarray(spd.exp(jnp.stack([jnp.stack([a, c], -1), jnp.stack([c, b], -1)], -2)))
