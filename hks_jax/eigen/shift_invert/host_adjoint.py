"""Linear solves with K − λᵢM on the complement of computed eigenvectors, on the host.

The method is described in `hks_jax.eigen.adjoints.complement`; the preconditioners are SciPy's factorisations.
"""

import os
from concurrent.futures import ThreadPoolExecutor
from itertools import repeat

import equinox as eqx
import jax
import numpy as np
from jax.typing import ArrayLike
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import SuperLU
from threadpoolctl import threadpool_limits

from hks_jax.eigen.adjoints import complement
from hks_jax.eigen.adjoints.complement import Adjoint, Rows, Values, Vectors
from hks_jax.fem.pencil import Pencil
from hks_jax.linear.conjugate_gradients import conjugate_gradients
from hks_jax.linear.host_matrices import factorise_stably_on_host, host_matrices
from hks_jax.traced import is_traced

_BLOCK = 16
"""The number of right-hand sides per block: enough for fast products, and few enough for the cache."""


class HostAdjoint(Adjoint[Pencil]):
    """Conjugate gradients, preconditioned with SciPy's factorisations, in float64 on the host.

    Under `jit` and `vmap`, the solver runs in a host callback, one problem at a time.

    Attributes:
        tolerance: the wanted error in the energy norm, relative to the largest right-hand side.

    Examples:
        >>> solver = hj.ShiftInvert(adjoint=hj.HostAdjoint(tolerance=1e-6))
        >>> domain = lambda s: hj.TensorField(field.grid, s * field.tensors)
        >>> scaled = lambda s: hj.hks(hj.eigenpairs(domain(s), 12, solver=solver), [0.5 * s], "volume")[0, 4, 4]
        >>> print(abs(jax.grad(scaled)(1.0)) < 1e-3)  # lengths and times grow alike
        True
    """

    tolerance: float = eqx.field(default=1e-12, static=True)

    def solve(self, prepared: None, pencil: Pencil, values: Values, vectors: Vectors, rhs: Rows) -> Rows:
        """Solve (K − λᵢM) xᵢ = Q rhsᵢ with ΦᵀMxᵢ = 0; see `Adjoint.solve`."""
        data, matrices = host_matrices(pencil)
        tolerance = complement.attainable(self.tolerance, rhs.dtype)
        n_data, result = len(data), jax.ShapeDtypeStruct(rhs.shape, rhs.dtype)

        def on_host(*inputs: ArrayLike) -> np.ndarray:
            values, vectors, b = (np.asarray(array, np.float64) for array in inputs[n_data:])
            if not all(np.isfinite(array).all() for array in (values, vectors, b)):
                return np.full(result.shape, np.nan, result.dtype)
            K, M = matrices(*inputs[:n_data])
            return _solve(K, M, values, vectors, b, tolerance, result.dtype).astype(result.dtype)

        inputs = *data, values, vectors, rhs
        if not is_traced(inputs):
            return jax.device_put(on_host(*inputs))
        return jax.pure_callback(on_host, result, *inputs, vmap_method="sequential")


def _solve(
    K: csc_matrix, M: csc_matrix, values: Values, vectors: Vectors, rhs: Rows, tolerance: float, dtype: np.dtype
) -> Rows:
    """Solve in float64; ``dtype`` is the dtype of the given eigenvectors and right-hand sides. See `Adjoint.solve`."""
    phi = np.ascontiguousarray(vectors.T)
    m_phi = M @ phi
    x = np.zeros_like(rhs)
    left = rhs - (rhs @ phi) @ m_phi.T
    before, after = (complement.norms(rows, M.diagonal()) for rows in (rhs, left))
    wanted = complement.wanted_errors(before, after, complement.amplification(values, len(rhs)), tolerance, dtype)
    rhs, beyond = left, complement.first_beyond(values)
    active = np.flatnonzero(np.isfinite(wanted))

    def solve(block: np.ndarray, factor: SuperLU) -> None:
        def precondition(r: np.ndarray) -> np.ndarray:
            left, result = r.any(axis=0), np.zeros_like(r)
            z = factor.solve(r[:, left])
            result[:, left] = z - phi @ (m_phi.T @ z)
            return result

        product = complement.definite_product(K.dot, M.dot, values[block], beyond)
        b = np.ascontiguousarray(rhs[block].T)
        with np.errstate(divide="ignore", invalid="ignore"):  # in finished columns
            x[block] = conjugate_gradients(product, precondition, b, wanted[block]).converged.T

    if not active.size:
        return x
    distance = beyond - values[active]
    number = complement.group_numbers(distance, active.size, tolerance)
    # Blocks are solved in parallel with one BLAS thread each; SuperLU's small BLAS calls gain nothing from threads.
    with threadpool_limits(1, user_api="blas"), ThreadPoolExecutor(os.cpu_count()) as threads:
        for group in np.unique(number):
            rows, own = active[number == group], distance[number == group]
            (shift,) = complement.shifts_between(values, own.min(keepdims=True), own.max(keepdims=True))
            blocks = [rows[start : start + _BLOCK] for start in range(0, rows.size, _BLOCK)]
            list(threads.map(solve, blocks, repeat(factorise_stably_on_host(K - shift * M))))
    return x
