"""Pencils as SciPy matrices, for computations on the host."""

from collections.abc import Callable

import jax
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float
from scipy.sparse import coo_matrix, csc_matrix, diags
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import SuperLU, splu

from hks_jax.linear.multifrontal import CONTRACTION
from hks_jax.linear.operators import Places
from hks_jax.linear.symmetric_pencil import SymmetricPencil, change_by_rounding

_EXACT = 1e-13
"""The sum of a row of K, relative to the sizes of the entries, up to which the sum is zero in double precision."""


def factorise_on_host(matrix: csc_matrix) -> SuperLU:
    """Factorise a symmetric matrix with a symmetric ordering, for least fill-in, and without pivoting."""
    return splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})


def factorise_stably_on_host(matrix: csc_matrix) -> SuperLU:
    """Factorise a symmetric indefinite matrix; with pivoting, at the price of more fill-in, only if accuracy needs it.

    On uniform grids, a pivot may cancel to zero although the matrix is well conditioned.
    """
    try:
        factor = factorise_on_host(matrix)
        if _contraction(matrix, factor) < CONTRACTION:
            return factor
    except RuntimeError:  # exactly singular
        pass
    return splu(matrix.tocsc())


def inertia(K: csc_matrix, M: csc_matrix, shift: float) -> tuple[SuperLU | None, int, float]:
    """Return a factorisation of K − σM, its number of negative pivots, and the convergence rate of refinement with it.

    The number is that of eigenvalues below σ if the rate is less than `CONTRACTION`. If K − σM is singular or needs
    pivoting, the rate is infinite.
    """
    matrix = (K - shift * M).tocsc()
    try:
        factor = factorise_on_host(matrix)
    except RuntimeError:  # exactly singular
        return None, 0, np.inf
    # If SuperLU exchanges rows, the pivots' signs are not the inertia.
    exchanged = (factor.perm_r != factor.perm_c).any()
    return factor, int((factor.U.diagonal() < 0).sum()), np.inf if exchanged else _contraction(matrix, factor)


def inertia_on_host(K: csc_matrix, M: csc_matrix, shift: float) -> tuple[int, bool]:
    """Return the number of eigenvalues below σ, by the inertia of K − σM, and whether a test confirms it."""
    _, negative, rate = inertia(K, M, shift)
    return negative, rate < CONTRACTION


def _contraction(matrix: csc_matrix, factor: SuperLU) -> float:
    """Return the largest factor by which a step of iterative refinement reduces random residuals."""
    residual = np.random.default_rng(0).standard_normal((matrix.shape[0], 4))
    rates = []
    for _ in range(2):
        before, residual = residual, residual - matrix @ factor.solve(residual)
        rates.append(np.linalg.norm(residual) / max(np.linalg.norm(before), np.finfo(float).tiny))
    return float(max(rates))


def host_matrices(pencil: SymmetricPencil) -> tuple[tuple[Array, ...], Callable[..., tuple[csc_matrix, csc_matrix]]]:
    """Return the arrays of a pencil, and a function that makes the SciPy matrices K and M from such arrays.

    The matrices are float64, and K is that before rounding (`Unrounded`). For a null vector v, rounding errors in Kv
    would act as a potential. If no node belongs to two null vectors, the rounding errors in Kv are subtracted from the
    diagonal of K.
    """
    source, n = pencil.unrounded, pencil.size
    (data_k, pattern_k), (data_m, pattern_m) = source.stiffness.triplets(), pencil.mass.triplets()

    def matrices(
        data_k: ArrayLike, origin: ArrayLike, data_m: ArrayLike, nulls: ArrayLike
    ) -> tuple[csc_matrix, csc_matrix]:
        K, M, vectors = _csc(data_k, pattern_k, n), _csc(data_m, pattern_m, n), np.asarray(nulls, np.float64)
        if ((vectors != 0).sum(axis=0) <= 1).all():
            vector = vectors.sum(axis=0)
            K = K - diags(np.where(vector != 0, (K @ vector) / np.where(vector != 0, vector, 1), 0))
        shift = float(np.asarray(origin))
        return K - shift * M if shift else K, M

    return (data_k, source.origin, data_m, source.null_vectors), matrices


def balanced(pencil: SymmetricPencil) -> Float[Array, "1 n_dof"]:
    """Return 1 on the components of the matrix K whose rows sum to zero within rounding, and 0 elsewhere.

    Each sum is compared with the effect of rounding on the row's entries. Rounding errors of different rows cancel in
    the sum of all entries, so its limit is less than the sum of the limits. A constant on the diagonal
    exceeds it.
    """
    (data, pattern), n, eps = pencil.stiffness.triplets(), pencil.size, np.finfo(pencil.stiffness.dtype).eps
    K = _csc(data, pattern, n)
    K.eliminate_zeros()
    number, label = connected_components(K, directed=False)
    sums, limits = K @ np.ones(n), eps * (abs(K) @ np.ones(n))
    total, limit = np.abs(np.bincount(label, sums, number)), np.sqrt(np.bincount(label, limits**2, number))
    balance = (np.bincount(label, np.abs(sums) > limits, number) == 0) & (total <= limit)
    return jax.device_put(balance[label][None].astype(pencil.stiffness.dtype))


def near_zero(
    pencil: SymmetricPencil, vectors: Float[np.ndarray, "m n_dof"], accurate: bool
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Return float64 Rayleigh quotients of K, not of K − σM, their changes by rounding of K's entries, and residuals.

    Unless the vectors are ``accurate``, the changes include the effect of rounding on the null vectors of K.
    """
    source, columns = pencil.unrounded, vectors.T.astype(np.float64)
    data, matrices = host_matrices(pencil)
    K, M = matrices(data[0], 0.0, *data[2:])
    sizes, sums = abs(K), K @ np.ones(pencil.size)
    limits = sizes @ np.ones(pencil.size)
    exact = np.abs(sums) <= _EXACT * limits if accurate else np.zeros(pencil.size, bool)
    force, image = K @ columns, M @ columns
    squares = np.sum(columns * image, axis=0)
    changes = change_by_rounding(sizes @ columns, np.where(exact, limits, 2 * limits), columns)
    rounding = np.finfo(source.stiffness.dtype).eps * changes / squares
    quotients = np.sum(columns * force, axis=0) / squares
    residuals = np.linalg.norm(force - quotients * image, axis=0) / np.linalg.norm(image, axis=0)
    return quotients, rounding, residuals


# The assembly computes the entries (i, j) and (j, i) separately, so their rounding errors differ. `host_matrices`
# corrects the sums of rows; without symmetry, the sums of columns would be wrong, and LAPACK reads only one triangle.
# In nearly cut domains, small eigenvalues in float32 would be wrong by the rounding error of the largest one.
def _csc(data: ArrayLike, pattern: Places, n: int) -> csc_matrix:
    """Return the symmetric part of a matrix."""
    matrix = coo_matrix((np.asarray(data, np.float64), pattern), shape=(n, n)).tocsc()
    return (matrix + matrix.T) / 2
