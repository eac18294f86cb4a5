"""Public functions and hard matrices in strict modes: `jax_debug_nans` on, and rank promotion an error.

The first checks run one call of every public function, and compiled steps where leaks of tracers and implicit
transfers are errors. Each further check takes a matrix of a kind that breaks solvers (a star, a complete graph,
isolated vertices, repeated blocks, two scales, a zero matrix, one bulk of equal eigenvalues) or a masked field, and
asks for its lowest pairs. Eigenvalues must be those of dense linear algebra, or be told; what JAX refuses in these
modes is an error of ours.
"""

import warnings

import jax
import numpy as np
import scipy.linalg
import scipy.sparse as sp
from public_calls import CALLS, STEPS, run_guarded, run_strictly

import hks_jax as hj

from .harness import Outcome


def check(seed: int) -> Outcome:
    """Run the call or the step with this number, or solve a random one of the matrices."""
    calls = [(run_strictly, name) for name in CALLS] + [(run_guarded, name) for name in STEPS]
    if seed < len(calls):
        run, name = calls[seed]
        run(name)
        return "right"
    rng = np.random.default_rng(seed)
    with warnings.catch_warnings(record=True) as said, jax.debug_nans(True), jax.numpy_rank_promotion("raise"):
        warnings.simplefilter("always")
        if rng.random() < 0.25:
            return _field(rng)
        name, K = _matrix(rng, int(rng.choice([40, 150])))
        k = int(rng.integers(1, 12))
        pairs = hj.eigsh(K, k=k)
        values = np.asarray(pairs.eigenvalues)
    exact = scipy.linalg.eigh(K.toarray(), eigvals_only=True)[:k]
    size = max(abs(K).max(), 1e-300)
    if np.abs(values - exact).max() <= 1e-9 * size:
        return "right"
    assert said, f"{name}, k = {k}: {values} are not {exact}, and nothing says so"
    return "told"


def _field(rng: np.random.Generator) -> Outcome:
    shape = (11, 9)
    mask = np.hypot(*(np.indices(shape) - 4.5)) < rng.uniform(3, 5)
    tensors = np.exp(0.3 * rng.standard_normal())[None] * np.broadcast_to(
        np.diag([1.0, rng.uniform(1, 9)]), (*shape, 2, 2)
    )
    boundary = str(rng.choice(["neumann", "dirichlet", "mean"]))
    pairs = hj.eigenpairs(hj.TensorField(hj.Grid(shape, 1.0, mask=mask, components="largest"), tensors), 5, boundary)
    values = np.asarray(hj.hks(pairs, [9.0, 30.0]))
    inside = pairs.space.domain
    assert (np.isnan(values) == ~inside).all(), "NaN not where the mask ends"
    return "right"


def _matrix(rng: np.random.Generator, n: int) -> tuple[str, sp.csr_matrix]:
    def laplacian(A: sp.spmatrix) -> sp.csr_matrix:
        A = sp.csr_matrix(A)
        return sp.csr_matrix(sp.diags(np.asarray(A.sum(axis=1)).ravel()) - A)

    path = sp.diags([-1.0, 2, -1], [-1, 0, 1], shape=(n // 5, n // 5))
    star = sp.lil_matrix((n, n))
    star[0, 1:] = star[1:, 0] = 1
    random = sp.random(n, n, 2 / n, random_state=int(rng.integers(2**31)))
    kinds = {
        "star": lambda: laplacian(star),
        "complete": lambda: laplacian(np.ones((n, n)) - np.eye(n)),
        "isolated vertices": lambda: laplacian(sp.block_diag([random + random.T, sp.csr_matrix((7, 7))])),
        "repeated": lambda: sp.kron(sp.eye(5), path),
        "two scales": lambda: sp.block_diag([path, 1e8 * path]),
        "zero": lambda: sp.csr_matrix((n, n)),
        "a bulk": lambda: sp.diags(np.concatenate([np.full(3, 1 - 7e-5), np.ones(n - 3)])),
        "random": lambda: random @ random.T - 0.5 * sp.eye(n),
    }
    name = str(rng.choice(list(kinds)))
    return name, sp.csr_matrix(kinds[name]()) * 10.0 ** rng.integers(-6, 7)
