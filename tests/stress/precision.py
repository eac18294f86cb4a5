"""Matrices and layered fields in float32 with digits that float32 does not hold, against float64.

Chains, cliques with weak links and random graphs, with constants on the diagonal; layers with tensors, densities and
potentials over several orders of magnitude. Each eigenvalue is within 1 % or within the effect of rounding the entries
of K, ε Σ|φᵢ||Kᵢⱼ||φⱼ|, or a warning tells.
"""

import warnings
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
import scipy.linalg
import scipy.sparse as sp

import hks_jax as hj

from .harness import Outcome

_ROUNDING = 4 * np.finfo(np.float32).eps
"""The error that rounding of fields and matrices to float32 may cause, relative to Σ|φᵢ||Kᵢⱼ||φⱼ|."""


def check(seed: int) -> Outcome:
    """Solve a random problem in float32."""
    rng = np.random.default_rng(seed)
    what, K, M, k, solve = (_graph if rng.random() < 0.5 else _layers)(rng)
    exact, vectors = scipy.linalg.eigh(K, M)
    sizes = np.abs(vectors[:, :k])
    allowed = np.maximum(_ROUNDING * np.sum(sizes * (np.abs(K) @ sizes), axis=0), 1e-2 * np.abs(exact[:k]))
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        pairs = solve()
    values = np.asarray(pairs.eigenvalues, float)
    if any("cuts a multiple" not in str(each.message) for each in told):
        return "told"
    assert not (np.diff(values) < 0).any(), f"{what}: eigenvalues are not ascending"
    wrong = ~(np.abs(values - exact[:k]) <= allowed)
    assert not wrong.any(), f"{what} by {pairs.solver_name}: got {values[wrong]}, exact are {exact[:k][wrong]}"
    return "right"


Problem = tuple[str, np.ndarray, np.ndarray, int, Callable[[], hj.Eigenpairs]]


def _graph(rng: np.random.Generator) -> Problem:
    n, kind = int(rng.choice([40, 120])), int(rng.integers(4))
    A = np.triu(sp.random(n, n, 4 / n, random_state=rng).toarray() + np.eye(n, k=1), 1)
    weak = 10.0 ** rng.uniform(-9, -1)
    if kind == 0:
        A = np.diag(10.0 ** rng.uniform(-rng.choice([0, 3]), 0, n - 1), 1)
    elif kind == 1:  # cliques with weak links
        A = np.triu(np.kron(np.eye(4), np.ones((n // 4, n // 4))), 1)
        A[np.arange(3) * n // 4, (np.arange(3) + 1) * n // 4] = weak
    elif kind == 2:  # nodes of very different weights
        weights = 10.0 ** rng.uniform(-3, 0, n)
        A = weights[:, None] * A * weights
    K, added = np.diag((A + A.T).sum(axis=1)) - A - A.T, rng.choice([0.0, 0.0, 1.0, -1.0]) * 10.0 ** rng.uniform(-6, 0)
    K, scale = K + added * np.eye(n), 10.0 ** rng.integers(-6, 7)
    M = 10.0 ** rng.uniform(-rng.choice([0, 0.5, 3]), 0, n)
    solver, k = rng.choice(["auto", "shift-invert", "dense"]), int(rng.choice([3, 8]))
    what = f"graph {kind} of {n} nodes, weak links {weak:.1e}, constant {added:.1e}, scale {scale:g}, {solver}"
    matrices = sp.csr_matrix(np.float32(scale * K)), np.float32(M)
    return what, scale * K, np.diag(M), k, lambda: hj.eigsh(*matrices, k, solver=solver)


def _layers(rng: np.random.Generator) -> Problem:
    shape = tuple(int(n) for n in rng.choice([13, 21], 2))
    grid = hj.Grid.from_bounds(0.0, 1.0, shape)
    x, y = np.moveaxis(grid.nodes, -1, 0)
    layer, ratio = x < 0.5, 10.0 ** rng.uniform(0, 4)
    step, one, kind = np.where(layer, 1.0, ratio), np.ones(shape), int(rng.integers(5))
    diagonal = [(one, one), (step, step), (1 / step, 1 / step), (step, one), (step, 1 / step)][kind]
    tensors = np.stack(diagonal, axis=-1)[..., None] * np.eye(2)
    size = 10.0 ** rng.uniform(-4, 3) * rng.choice([1, 1, -1])
    potential = [None, size * one, size * (x + y * y), size * (1 + x) * np.where(y < 0.5, 1, 1e-3)][rng.integers(4)]
    density = [None, 10 ** (2 * x), step, 1 / step][rng.integers(4)]
    boundary, k = str(rng.choice(["neumann", "neumann", "dirichlet"])), int(rng.choice([4, 10]))
    solver = str(rng.choice(["auto", "shift-invert", "dense"]))

    def pencil(dtype: Any) -> hj.Pencil:
        given = {"potential": potential, "density": density}
        fields = {name: jnp.asarray(values, dtype) for name, values in given.items() if values is not None}
        return hj.assemble(hj.TensorField(grid, jnp.asarray(tensors, dtype)), boundary, **fields)

    double = pencil(jnp.float64)
    K, M = (np.asarray(matrix.to_dense()) for matrix in (double.stiffness, double.mass))
    what = f"layers {kind} of 1 : {ratio:.1e}, potential {size:.1e}, density, {boundary}, {solver}"
    return what, K, M, k, lambda: hj.eigenpairs(pencil(jnp.float32), k, solver=solver)
