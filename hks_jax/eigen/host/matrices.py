"""Pencils as SciPy matrices, for computations on the host."""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array
from scipy.sparse import coo_matrix, csc_matrix, diags
from scipy.sparse.linalg import SuperLU, splu

from hks_jax.linear.multifrontal import CONTRACTION
from hks_jax.linear.operators import Places
from hks_jax.linear.pencil import SymmetricPencil


def factorise_on_host(matrix: csc_matrix) -> SuperLU:
    """Factorise a symmetric matrix with a symmetric ordering, for least fill-in, and without pivoting."""
    return splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})


def inertia_on_host(K: csc_matrix, M: csc_matrix, shift: float) -> tuple[int, bool]:
    """Return the number of eigenvalues below σ, by the inertia of K − σM, and whether a test confirms it."""
    matrix = (K - shift * M).tocsc()
    try:
        factor = factorise_on_host(matrix)
    except RuntimeError:  # exactly singular
        return 0, False
    residual = np.random.default_rng(0).standard_normal((K.shape[0], 4))
    rates = []
    for _ in range(2):
        before, residual = residual, residual - matrix @ factor.solve(residual)
        rates.append(np.linalg.norm(residual) / max(np.linalg.norm(before), np.finfo(float).tiny))
    # If SuperLU exchanges rows, the pivots' signs are not the inertia.
    sound = bool(max(rates) < CONTRACTION and (factor.perm_r == factor.perm_c).all())
    return int((factor.U.diagonal() < 0).sum()), sound


def host_matrices(pencil: SymmetricPencil) -> tuple[tuple[Array, ...], Callable[..., tuple[csc_matrix, csc_matrix]]]:
    """Return arrays of K, M and the null vectors of K, and a function that makes SciPy matrices from such arrays.

    The matrices are float64. For a null vector v, rounding errors in Kv would act as a potential. If each node belongs
    to exactly one null vector, the rounding errors in Kv are subtracted from the diagonal of K.
    """
    (data_k, pattern_k), (data_m, pattern_m) = pencil.stiffness.triplets(), pencil.mass.triplets()
    n = pencil.size
    nulls = jnp.zeros((0, n), data_k.dtype) if pencil.null_space is None else pencil.null_space.vectors

    def matrices(data_k: ArrayLike, data_m: ArrayLike, nulls: ArrayLike) -> tuple[csc_matrix, csc_matrix]:
        K, M, vectors = _csc(data_k, pattern_k, n), _csc(data_m, pattern_m, n), np.asarray(nulls, np.float64)
        if ((vectors != 0).sum(axis=0) == 1).all():
            vector = vectors.sum(axis=0)
            K = K - diags((K @ vector) / vector)
        return K, M

    return (data_k, data_m, nulls), matrices


def _csc(data: ArrayLike, pattern: Places, n: int) -> csc_matrix:
    return coo_matrix((np.asarray(data, np.float64), pattern), shape=(n, n)).tocsc()
