"""Pencils as SciPy matrices: what the host computes for solvers in JAX, through callbacks where they are traced."""

from collections.abc import Callable

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array
from scipy.sparse import coo_matrix, csc_matrix, diags
from scipy.sparse.linalg import SuperLU, splu

from hks_jax.fem.pencil import Pencil
from hks_jax.linear.multifrontal import CONTRACTION
from hks_jax.linear.operators import Places


def factorise_on_host(matrix: csc_matrix) -> SuperLU:
    """Factorise a symmetric matrix without pivoting, under a symmetric ordering, which fills in least."""
    return splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})


def inertia_on_host(K: csc_matrix, M: csc_matrix, shift: float) -> tuple[int, bool]:
    """Return the number of eigenvalues below the shift, and whether it is certain.

    By the negative pivots of K − σM; the test is that of `hks_jax.linear.multifrontal.try_out`.
    """
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
    # Were rows exchanged, pivots would not be those of a congruence.
    sound = bool(max(rates) < CONTRACTION and (factor.perm_r == factor.perm_c).all())
    return int((factor.U.diagonal() < 0).sum()), sound


def host_matrices(pencil: Pencil) -> tuple[tuple[Array, Array], Callable[..., tuple[csc_matrix, csc_matrix]]]:
    """Return the entries of K and M, and the function that makes float64 SciPy matrices of them on the host."""
    (data_k, pattern_k), (data_m, pattern_m) = pencil.stiffness.triplets(), pencil.mass.triplets()
    n = pencil.space.n_dof
    natural = bool((pencil.space.free == pencil.space.domain).all())

    def matrices(data_k: ArrayLike, data_m: ArrayLike) -> tuple[csc_matrix, csc_matrix]:
        K, M = _csc(data_k, pattern_k, n), _csc(data_m, pattern_m, n)
        if natural:  # the rows add up to zero; what float32 entries leave would act as a potential
            K = K - diags(np.asarray(K.sum(axis=1)).ravel())
        return K, M

    return (data_k, data_m), matrices


def _csc(data: ArrayLike, pattern: Places, n: int) -> csc_matrix:
    return coo_matrix((np.asarray(data, np.float64), pattern), shape=(n, n)).tocsc()
