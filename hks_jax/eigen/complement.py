"""Solves with K − λᵢM on the complement of known eigenvectors, on the host.

The derivatives of a truncated spectrum need them.

On the M-orthogonal complement of the p lowest eigenvectors K − λᵢM is positive definite, and so is K − σM for *every*
σ below the next eigenvalue Λ, whatever its sign elsewhere. Preconditioned with it, the spectrum of conjugate gradients
lies between 1 and (Λ − λᵢ)/(Λ − σ). So the columns are grouped by their λᵢ, each group has its own shift σ among them,
and a few factorisations bring every column to convergence in a few steps.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import repeat

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import SuperLU
from threadpoolctl import threadpool_limits

_BLOCK = 16
"""Columns solved at once: enough for fast products, few enough for the cache."""
_FACTORISATION = 100
"""What one factorisation costs, in solves of one column."""
_MOST_GROUPS = 16
MAX_ITERATIONS = 200
SINGULAR = 1e-8
"""The gap, relative to the last eigenvalue, below which K − λᵢM counts as singular on the complement."""


def solve_complement(
    K: csc_matrix,
    M: csc_matrix,
    values: np.ndarray,
    vectors: np.ndarray,
    rhs: np.ndarray,
    *,
    factorise: Callable[[csc_matrix], SuperLU],
    tolerance: float,
    report: Callable[[str], None],
) -> tuple[np.ndarray, np.ndarray]:
    """Solve (K − λᵢM) xᵢ = Q rhsᵢ with ΦᵀMxᵢ = 0.

    Args:
        K: stiffness.
        M: mass.
        values: (p,) the lowest eigenvalues, ascending.
        vectors: (p, n) their M-orthonormal eigenvectors Φ; Q = I − MΦΦᵀ.
        rhs: (k, n), k ≤ p; row i belongs to λᵢ.
        factorise: factorises a symmetric, possibly indefinite matrix.
        tolerance: reduction of the error in the energy norm, relative to the largest row.
        report: told in words how it goes.

    Returns:
        x (k, n), and the relative energy errors (k,) that the iteration saw last, in units of the tolerance asked of
        each row: above 1 it did not converge.
    """
    phi = np.ascontiguousarray(vectors.T)
    m_phi = M @ phi
    x, errors = np.zeros_like(rhs), np.zeros(len(rhs))
    rhs = rhs - (rhs @ phi) @ m_phi.T
    # Small rows need fewer digits, or none: their share in what is summed over all rows is small. Where the operator
    # amplifies more, because λᵢ is near Λ, they count for more.
    beyond = values[-1] * (1 + 1 / values.size) if values[-1] > 0 else 1.0
    distance = beyond - values[: len(rhs)]
    size = np.sqrt(np.einsum("in,in->i", rhs, rhs / M.diagonal()))
    share = size / max(size.max(initial=0.0), np.finfo(float).tiny) * (beyond / distance)
    active = np.flatnonzero(share > tolerance)
    wanted = np.minimum(tolerance / np.maximum(share, tolerance), 0.1)
    done = 0

    def solve(block: np.ndarray, factor: SuperLU) -> None:
        nonlocal done
        solution, errors[block] = _conjugate_gradients(
            K, M, values[block], phi, m_phi, rhs[block].T, factor, wanted[block], beyond
        )
        x[block] = solution.T
        done += block.size
        report(f"derivative: {done} of {active.size} solves")

    # Blocks are solved side by side, each with one BLAS thread: SuperLU's many small BLAS calls do not gain by more.
    with threadpool_limits(1, user_api="blas"), ThreadPoolExecutor(os.cpu_count()) as threads:
        for rows, shift in _groups(values, beyond, active, tolerance):
            blocks = [rows[start : start + _BLOCK] for start in range(0, rows.size, _BLOCK)]
            list(threads.map(solve, blocks, repeat(factorise(K - shift * M))))
    return x, errors


def _conjugate_gradients(
    K: csc_matrix,
    M: csc_matrix,
    eigenvalues: np.ndarray,
    phi: np.ndarray,
    m_phi: np.ndarray,
    b: np.ndarray,
    factor: SuperLU,
    wanted: np.ndarray,
    beyond: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Solve a block of columns; return x (n, b) and the errors over the wanted ones (b,)."""

    def precondition(r: np.ndarray) -> np.ndarray:
        z = factor.solve(r)
        return z - phi @ (m_phi.T @ z)

    x, errors = np.zeros_like(b), np.zeros(b.shape[1])
    left = np.arange(b.shape[1])
    r = np.ascontiguousarray(b)
    p = z = precondition(r)
    first = energy = np.einsum("nb,nb->b", r, z)
    for _ in range(MAX_ITERATIONS):
        if left.size == 0:
            break
        m_p = M @ p
        a_p = K @ p - m_p * eigenvalues[left]
        curvature = np.einsum("nb,nb->b", p, a_p)
        # Where it nearly vanishes, an eigenvalue equal to λᵢ is left on the complement: there is no solution.
        regular = curvature > SINGULAR * beyond * np.einsum("nb,nb->b", p, m_p)
        length = energy / np.where(regular, curvature, np.inf)
        x[:, left] += length * p
        r = r - length * a_p
        z = precondition(r)
        before, energy = energy, np.einsum("nb,nb->b", r, z)
        errors[left] = np.where(regular, np.sqrt(np.abs(energy) / first[left]) / wanted[left], np.inf)
        open_ = (errors[left] > 1) & regular
        p = z + (energy / before) * p
        if not open_.all():  # go on with the others alone
            left, r, p, energy = left[open_], r[:, open_], p[:, open_], energy[open_]
    return x, errors


def _groups(values: np.ndarray, beyond: float, active: np.ndarray, tolerance: float) -> list[tuple[np.ndarray, float]]:
    """Split rows into groups of neighbouring eigenvalues, and give each a shift.

    With Λ − λᵢ between a and b in a group and the shift at Λ − √(ab), the condition is √(a/b).
    """
    if active.size == 0:
        return []
    number = group_numbers(beyond - values[active], active.size, tolerance)
    groups = []
    for i in np.unique(number):
        rows = active[number == i]
        ends = beyond - values[rows]
        groups.append((rows, _between(values, beyond - float(np.sqrt(ends.min() * ends.max())))))
    return groups


def group_numbers(
    distance: Float[np.ndarray, " m"], rows: int, tolerance: float, most: int = _MOST_GROUPS
) -> Int[np.ndarray, " m"]:
    """Return the group of each distance from Λ, of at most so many groups in geometric progression.

    With s groups of distances that differ by up to a ratio ρ the condition is ρ^(1/2s); s weighs factorisations against
    the steps for all rows.
    """
    ratio = max(distance.max() / distance.min(), 1 + 1e-12)

    def cost(s: int) -> float:
        root = ratio ** (1 / (4 * s))
        return s * _FACTORISATION + rows * np.log(2 / tolerance) / np.log((root + 1) / (root - 1))

    count = min(min(range(1, _MOST_GROUPS + 1), key=cost), most)
    return np.minimum((np.log(distance.max() / distance) / np.log(ratio) * count).astype(int), count - 1)


def _between(values: np.ndarray, target: float) -> float:
    """Return the middle of a gap in the spectrum near the target, so that the shift is no eigenvalue."""
    gaps = np.diff(values)
    typical = (values[-1] - values[0]) / max(values.size - 1, 1)
    wide = np.flatnonzero(gaps >= 0.1 * typical)
    if wide.size == 0 or typical == 0:
        return -0.1 if values[-1] <= 0 else -0.1 * float(values[-1])
    middles = (values[wide] + values[wide + 1]) / 2
    return float(middles[np.argmin(np.abs(middles - target))])
