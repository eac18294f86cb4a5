"""Eigenpairs by every solver, plain and under jit, against dense linear algebra.

A result is right if every eigenvalue and every residual is; it may be wrong where it tells so: by a warning when called
plainly, by its result code under jit.
"""

import warnings

import equinox as eqx
import numpy as np
import scipy.linalg

import hks_jax as hj

from .harness import Outcome
from .problems import Problem, random_problem

_SOLVERS = (
    "auto",
    "dense",
    "shift-invert",
    "block-lanczos",
    hj.BlockLanczos(block=4, slice_size=14),
    "chebyshev-filter",
    hj.ChebyshevFilter(block=8),
)
_EXACT = 1e-6
"""Relative error of eigenvalues that are right, beyond what rounding in the matrices makes of them."""


def check(seed: int) -> Outcome:
    """Solve a random problem by one of the solvers."""
    rng = np.random.default_rng(seed)
    problem = random_problem(seed)
    k, solver, traced = int(rng.choice([7, 39])), _SOLVERS[rng.integers(len(_SOLVERS))], rng.random() < 0.4
    spectrum, matrices = _reference(problem)
    what = f"{problem}, k = {k}, {solver}, {'jit' if traced else 'plain'}"
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        try:
            # Domain, k and solver are few: what is compiled for one field serves the others.
            pairs = (_jitted if traced else _solve)(problem.pencil(), k, solver)
        except ValueError as error:
            if "use" not in str(error).lower():
                raise AssertionError(f"{what}: refused without a remedy") from error
            return "refused"
    limited = traced and bool(pairs.result != hj.RESULTS.successful)
    limited |= any("did not converge" in str(w.message) or "confirm" in str(w.message) for w in told)
    values = np.asarray(pairs.eigenvalues)
    rounding = 64 * np.finfo(float).eps * spectrum[-1]
    scale = np.maximum(spectrum[:k], spectrum[min(pairs.n_null, k - 1)])
    wrong = ~(np.abs(values - spectrum[:k]) <= _EXACT * scale + rounding)
    if limited:
        return "told"
    assert not wrong.any(), (
        f"{what}: eigenvalue {int(np.argmax(wrong))} is {values[np.argmax(wrong)]!r}, should be "
        f"{spectrum[np.argmax(wrong)]!r}, {int(wrong.sum())} are wrong"
    )
    assert np.isfinite(np.asarray(pairs.vectors)).all(), f"{what}: eigenvectors are not finite"
    bound = float(pairs.complete_below)
    assert np.isnan(bound) or np.sum(spectrum < bound * (1 - 1e-12)) <= _known(pairs, bound, spectrum), (
        f"{what}: complete below {bound!r} is not true"
    )
    _check_orthonormal(pairs, matrices, what)
    return "right"


def _known(pairs: hj.Eigenpairs, bound: float, spectrum: np.ndarray) -> int:
    """Return how many eigenvalues below the bound are known: all, where it is beyond the last of the pairs."""
    return spectrum.size if bound > pairs.eigenvalues[-1] else int(np.sum(np.asarray(pairs.eigenvalues) < bound))


def _check_orthonormal(pairs: hj.Eigenpairs, matrices: list[tuple[np.ndarray, np.ndarray]], what: str) -> None:
    if len(matrices) > 1:  # of reflected domains, the parts are
        return
    M, vectors = matrices[0][1], np.asarray(pairs.vectors)
    error = np.abs(vectors @ M @ vectors.T - np.eye(pairs.k)).max()
    assert error < 1e-6, f"{what}: eigenvectors are not M-orthonormal, by {error:.1e}"


def _reference(problem: Problem) -> tuple[np.ndarray, list[tuple[np.ndarray, np.ndarray]]]:
    matrices = [
        (np.asarray(part.stiffness.to_dense()), np.asarray(part.mass.to_dense())) for part in problem.pencil().parts
    ]
    return np.sort(np.concatenate([scipy.linalg.eigh(K, M, eigvals_only=True) for K, M in matrices])), matrices


def _solve(pencil: hj.Pencil, k: int, solver: str | hj.Eigensolver) -> hj.Eigenpairs:
    return hj.eigenpairs(pencil, k, solver=solver)


_jitted = eqx.filter_jit(_solve)
