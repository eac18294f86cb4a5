"""Solves with K − λᵢM on the complement of known eigenvectors, on the host.

Conjugate gradients, preconditioned with SciPy's factorisations of K − σM: the method of
`hks_jax.eigen.complement.adjoint`.
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
from hks_jax.eigen.complement.adjoint import (
    SINGULAR,
    Adjoint,
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
from hks_jax.linear.conjugate_gradients import conjugate_gradients
from hks_jax.traced import is_traced

_BLOCK = 16
"""Columns solved at once: enough for fast products, few enough for the cache."""


class HostAdjoint(Adjoint[Pencil]):
    """Conjugate gradients, preconditioned with SciPy's factorisations, in float64 on the host.

    Under `jit` and `vmap` it runs through a host callback, one problem at a time.

    Attributes:
        tolerance: of the error in the energy norm, relative to the largest row.
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
        """Solve (K − λᵢM) xᵢ = Q rhsᵢ with ΦᵀMxᵢ = 0; see `Adjoint.solve`. It warns of rows that do not converge."""
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
            x = _solve(K, M, values, vectors, b, tolerance, rhs.dtype)
            if failed := int(np.isnan(x).any(axis=1).sum()):
                warn_of_accuracy(unsolved(failed, len(x)))
            return x.astype(rhs.dtype)

        inputs = *data, values, vectors, rhs
        if not is_traced(inputs):
            return jax.device_put(on_host(*inputs))
        shape = jax.ShapeDtypeStruct(rhs.shape, rhs.dtype)
        return jax.pure_callback(on_host, shape, *inputs, vmap_method="sequential")


def _solve(
    K: csc_matrix,
    M: csc_matrix,
    values: np.ndarray,
    vectors: np.ndarray,
    rhs: np.ndarray,
    tolerance: float,
    dtype: np.dtype,
) -> np.ndarray:
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
        x (k, n); NaN where the iteration did not converge.
    """
    phi = np.ascontiguousarray(vectors.T)
    m_phi = M @ phi
    x = np.zeros_like(rhs)
    left = rhs - (rhs @ phi) @ m_phi.T
    before, after = (norms(rows, M.diagonal()) for rows in (rhs, left))
    wanted = wanted_errors(before, after, before.max(), amplification(values, len(rhs)), tolerance, dtype)
    rhs, beyond = left, float(first_beyond(values))
    active = np.flatnonzero(np.isfinite(wanted))

    def solve(block: np.ndarray, factor: SuperLU) -> None:
        def precondition(r: np.ndarray) -> np.ndarray:
            left, result = r.any(axis=0), np.zeros_like(r)
            z = factor.solve(r[:, left])
            result[:, left] = z - phi @ (m_phi.T @ z)
            return result

        def product(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            image = M @ p
            return K @ p - values[block] * image, SINGULAR * beyond * np.einsum("nb,nb->b", p, image)

        b = np.ascontiguousarray(rhs[block].T)
        with np.errstate(divide="ignore", invalid="ignore"):  # of columns that are done
            x[block] = conjugate_gradients(product, precondition, b, wanted[block]).converged.T

    # Blocks are solved side by side, each with one BLAS thread: SuperLU's many small BLAS calls do not gain by more.
    with threadpool_limits(1, user_api="blas"), ThreadPoolExecutor(os.cpu_count()) as threads:
        for rows, shift in _groups(values, beyond, active, tolerance):
            blocks = [rows[start : start + _BLOCK] for start in range(0, rows.size, _BLOCK)]
            list(threads.map(solve, blocks, repeat(factorise_on_host(K - shift * M))))
    return x


def _groups(values: np.ndarray, beyond: float, active: np.ndarray, tolerance: float) -> list[tuple[np.ndarray, float]]:
    """Split rows into groups of neighbouring eigenvalues, and give each a shift."""
    if active.size == 0:
        return []
    distance = beyond - values[active]
    number = group_numbers(distance, active.size, tolerance)
    groups = [number == i for i in np.unique(number)]
    ends = [np.array([end(distance[group]) for group in groups]) for end in (np.min, np.max)]
    return [(active[group], float(shift)) for group, shift in zip(groups, shifts_between(values, *ends), strict=True)]
