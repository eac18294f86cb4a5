"""`eigsh` on random sparse pencils, against dense linear algebra.

Definite, singular with several null vectors, indefinite, with multiple eigenvalues; scaled by many orders of magnitude;
M absent, diagonal, or with a pattern of its own. A result is right, or a warning tells, or an interval's end is refused
as an eigenvalue.
"""

import warnings

import numpy as np
import scipy.linalg
import scipy.sparse as sp

import hks_jax as hj

from .harness import Outcome

_SOLVER = hj.BlockLanczos(block=4, slice_size=20)
_SIZES = (150, 260)
_EXACT = 1e-6
"""Error of eigenvalues that are right, relative to their distance from the lowest of those sought."""


def check(seed: int) -> Outcome:
    """Solve a random problem by slices."""
    # Of a few patterns each: what is compiled for one matrix serves the others.
    rng, structure = np.random.default_rng(seed), np.random.default_rng(seed // 40)
    n = int(structure.choice(_SIZES))
    K, name = _stiffness(structure, rng, n)
    M, of_mass = _mass(structure, rng, K)
    scale = 10.0 ** rng.integers(-8, 9)
    dense = np.eye(n) if M is None else M.toarray() if sp.issparse(M) else np.diag(M)
    spectrum = scipy.linalg.eigh((scale * K).toarray(), dense, eigvals_only=True)
    k = int(rng.choice([6, 20]))
    exact = spectrum[:k]
    what = f"{name}, n = {n}, {of_mass}, scale {scale:g}, k = {k}"
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        try:
            pairs = hj.eigsh(scale * K, M, k, solver=_SOLVER)
        except ValueError as error:
            raise AssertionError(f"{what}: {error}") from error
    if any("did not converge" in str(w.message) or "confirm" in str(w.message) for w in told):
        return "told"
    size = np.maximum(exact - spectrum[0], np.ptp(exact) / len(exact)) + 1e-9 * np.ptp(spectrum)
    wrong = ~(np.abs(np.asarray(pairs.eigenvalues) - exact) <= _EXACT * size)
    assert not wrong.any(), f"{what}: {int(wrong.sum())} eigenvalues are wrong, of {pairs.k}"
    vectors = np.asarray(pairs.vectors)
    error = np.abs(vectors @ dense @ vectors.T - np.eye(pairs.k)).max()
    assert error < 1e-6, f"{what}: eigenvectors are not M-orthonormal, by {error:.1e}"
    return "right"


def _stiffness(structure: np.random.Generator, rng: np.random.Generator, n: int) -> tuple[sp.csr_matrix, str]:
    """Return a matrix whose pattern depends on the first generator alone."""
    hits = sp.random(n, n, 2 / n, random_state=structure) + sp.eye(n, k=1)
    graph = (hits + hits.T).tocsr()
    graph.setdiag(0)
    graph.data[:] = np.abs(graph.data)
    kind = int(structure.integers(4))
    if kind == 0:  # the Laplacian of a few components, with weights over several orders of magnitude
        label = np.arange(n) * 3 // n
        rows, cols = graph.nonzero()
        graph = sp.csr_matrix((np.where(label[rows] == label[cols], 1.0, 0.0), (rows, cols)), shape=(n, n))
        side = 10.0 ** rng.uniform(0, rng.choice([0.5, 3]), n)
        graph = sp.diags(side) @ graph @ sp.diags(side)
        return (sp.diags(np.asarray(graph.sum(axis=1)).ravel()) - graph).tocsr(), "Laplacian of components"
    if kind == 1:
        return (graph + sp.diags(5 * rng.standard_normal(n))).tocsr(), "indefinite"
    if kind == 2:  # equal blocks: every eigenvalue several times
        block = graph[: n // 5, : n // 5] + sp.diags(rng.uniform(1, 4, n // 5))
        rest = sp.diags(rng.uniform(1, 4, n - 5 * (n // 5)))
        return sp.block_diag([block] * 5 + [rest]).tocsr(), "equal blocks"
    low = graph + 3 * sp.eye(n)
    return (low @ sp.diags((structure.random(n) < 0.95).astype(float)) @ low.T).tocsr(), "singular products"


def _mass(structure: np.random.Generator, rng: np.random.Generator, K: sp.csr_matrix) -> tuple:
    n, kind = K.shape[0], int(structure.integers(3))
    if kind == 0:
        return None, "M = 1"
    if kind == 1:
        return 10.0 ** rng.uniform(-1, 1, n), "diagonal M"
    low = sp.random(n, n, 1 / n, random_state=structure)
    return (low @ low.T + sp.diags(rng.uniform(1, 2, n))).tocsr(), "M of its own"
