"""Solves with K − λᵢM on the complement of known eigenvectors, on the host.

Conjugate gradients, preconditioned with SciPy's factorisations of K − σM: the method of
`hks_jax.eigen.complement.common`.
"""

import os
from concurrent.futures import ThreadPoolExecutor
from itertools import repeat
from typing import ClassVar

import equinox as eqx
import jax
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import SuperLU
from threadpoolctl import threadpool_limits

from hks_jax.accuracy import warn_of_accuracy
from hks_jax.eigen.complement.adjoint import Adjoint
from hks_jax.eigen.complement.common import (
    SINGULAR,
    amplification,
    attainable,
    first_beyond,
    group_numbers,
    norms,
    shifts_between,
    unsolved,
    wanted_errors,
)
from hks_jax.eigen.host.matrices import factorise_on_host, host_matrices
from hks_jax.fem.pencil import Pencil
from hks_jax.linear.conjugate_gradients import MAX_ITERATIONS

_BLOCK = 16
"""Columns solved at once: enough for fast products, few enough for the cache."""


class HostAdjoint(Adjoint[Pencil]):
    """Conjugate gradients, preconditioned with SciPy's factorisations, in float64 on the host.

    Under `jit` and `vmap` it runs through a host callback, one problem at a time.

    Attributes:
        tolerance: to what the error is reduced, in the energy norm, relative to the largest row.
    """

    warns: ClassVar[bool] = True
    tolerance: float = eqx.field(default=1e-12, static=True)

    def solve(
        self,
        prepared: None,
        pencil: Pencil,
        values: Float[Array, " p"],
        vectors: Float[Array, "p n_dof"],
        rhs: Float[Array, "k n_dof"],
    ) -> Float[Array, "k n_dof"]:
        """Solve (K − λᵢM) xᵢ = Q rhsᵢ with ΦᵀMxᵢ = 0; see `Adjoint.solve`. It warns of what does not converge."""
        data, matrices = host_matrices(pencil)
        tolerance = attainable(self.tolerance, rhs.dtype)

        def on_host(data_k: ArrayLike, data_m: ArrayLike, nulls: ArrayLike, *arrays: ArrayLike) -> np.ndarray:
            values, vectors, b = (np.asarray(array, np.float64) for array in arrays)
            if not all(np.isfinite(array).all() for array in (values, vectors, b)):
                warn_of_accuracy(
                    f"derivative: {int(np.isnan(values).sum())} of the {values.size} eigenpairs that it needs (guards "
                    "beyond k included) did not converge, and it is NaN. Allow more restarts, or a larger basis",
                )
                return np.full(rhs.shape, np.nan, rhs.dtype)
            K, M = matrices(data_k, data_m, nulls)
            x, errors = _solve(K, M, values, vectors, b, tolerance, rhs.dtype)
            failed = ~(errors <= 1)
            if failed.any():
                warn_of_accuracy(unsolved(int(failed.sum()), failed.size))
                x[failed] = np.nan
            return x.astype(rhs.dtype)

        shape = jax.ShapeDtypeStruct(rhs.shape, rhs.dtype)
        return jax.pure_callback(on_host, shape, *data, values, vectors, rhs, vmap_method="sequential")


def _solve(
    K: csc_matrix,
    M: csc_matrix,
    values: np.ndarray,
    vectors: np.ndarray,
    rhs: np.ndarray,
    tolerance: float,
    dtype: np.dtype,
) -> tuple[np.ndarray, np.ndarray]:
    """Solve (K − λᵢM) xᵢ = Q rhsᵢ with ΦᵀMxᵢ = 0.

    Args:
        K: stiffness.
        M: mass.
        values: (p,) the lowest eigenvalues, ascending.
        vectors: (p, n) their M-orthonormal eigenvectors Φ; Q = I − MΦΦᵀ.
        rhs: (k, n), k ≤ p; row i belongs to λᵢ.
        tolerance: reduction of the error in the energy norm, relative to the largest row.
        dtype: what eigenvectors and right-hand sides were rounded to before they came here as float64.

    Returns:
        x (k, n), and the relative energy errors (k,) that the iteration saw last, in units of the tolerance asked of
        each row: above 1 it did not converge.
    """
    phi = np.ascontiguousarray(vectors.T)
    m_phi = M @ phi
    x, errors = np.zeros_like(rhs), np.zeros(len(rhs))
    left = rhs - (rhs @ phi) @ m_phi.T
    before, after = (norms(rows, M.diagonal()) for rows in (rhs, left))
    wanted = wanted_errors(before, after, before.max(), amplification(values, len(rhs)), tolerance, dtype)
    rhs, beyond = left, float(first_beyond(values))
    active = np.flatnonzero(np.isfinite(wanted))

    def solve(block: np.ndarray, factor: SuperLU) -> None:
        solution, errors[block] = _conjugate_gradients(
            K, M, values[block], phi, m_phi, rhs[block].T, factor, wanted[block], beyond
        )
        x[block] = solution.T

    # Blocks are solved side by side, each with one BLAS thread: SuperLU's many small BLAS calls do not gain by more.
    with threadpool_limits(1, user_api="blas"), ThreadPoolExecutor(os.cpu_count()) as threads:
        for rows, shift in _groups(values, beyond, active, tolerance):
            blocks = [rows[start : start + _BLOCK] for start in range(0, rows.size, _BLOCK)]
            list(threads.map(solve, blocks, repeat(factorise_on_host(K - shift * M))))
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
    """Split rows into groups of neighbouring eigenvalues, and give each a shift."""
    if active.size == 0:
        return []
    distance = beyond - values[active]
    number = group_numbers(distance, active.size, tolerance)
    groups = [number == i for i in np.unique(number)]
    ends = [np.array([end(distance[group]) for group in groups]) for end in (np.min, np.max)]
    return [(active[group], float(shift)) for group, shift in zip(groups, shifts_between(values, *ends), strict=True)]
