"""All eigenpairs by dense linear algebra: the reference for every other solver."""

from functools import partial
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.linalg import cholesky, eigh, solve_triangular

from hks_jax.compilation import is_concrete_on_cpu
from hks_jax.eigen.host.matrices import host_matrices
from hks_jax.eigen.solver import Eigensolver, RawPairs, Report, silent
from hks_jax.linear.dense_eigh import pencil_eigh
from hks_jax.linear.pencil import SymmetricPencil


class Dense(Eigensolver[SymmetricPencil]):
    """Dense solver: `eigh` of L⁻¹KL⁻ᵀ, where M = LLᵀ. Takes O(n³) time and O(n²) memory; finds all multiplicities.

    Examples:
        >>> flat = hj.TensorField(field.grid, np.tile(np.eye(2), (9, 9, 1, 1)))
        >>> print((hj.eigenpairs(flat, k=4, solver=hj.Dense()).eigenvalues / jnp.pi**2).round(1))
        [0. 1. 1. 2.]
    """

    name: ClassVar[str] = "dense"
    tolerance: float = eqx.field(default=1e-8, static=True)

    def lowest(self, pencil: SymmetricPencil, k: int, report: Report = silent) -> RawPairs:
        """Return the k lowest eigenpairs. Concrete values are handed to SciPy, which needs no compilation."""
        if not is_concrete_on_cpu(pencil):
            return _dense(pencil.stiffness.to_dense(), pencil.mass.to_dense(), k)
        data, matrices = host_matrices(pencil)
        dtype = pencil.stiffness.dtype
        stiffness, mass = (matrix.toarray() for matrix in matrices(*data))
        values, vectors = _on_host(stiffness, mass, k)
        # `asarray` would return NumPy arrays while JAX differentiates.
        return jax.device_put((values.astype(dtype), vectors.astype(dtype), np.asarray(np.inf, dtype)))

    def guards(self, k: int, n_dof: int) -> int:
        """Return n_dof − k: with all pairs computed, derivatives need no linear solve."""
        return n_dof - k


@partial(jax.jit, static_argnames="k")
def _dense(stiffness: Float[Array, "n n"], mass: Float[Array, "n n"], k: int) -> RawPairs:
    values, vectors = pencil_eigh(stiffness, mass, k)
    return values, vectors.T, jnp.asarray(jnp.inf, values.dtype)


def _on_host(
    stiffness: Float[np.ndarray, "n n"], mass: Float[np.ndarray, "n n"], k: int
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "k n"]]:
    """Return the k lowest eigenpairs; NaN if K is not finite or M is not positive definite."""
    n = len(stiffness)
    try:
        factor = cholesky(mass, lower=True)
        half = solve_triangular(factor, stiffness, lower=True)
        reduced = solve_triangular(factor, half.T, lower=True)
        few = 3 * k < n  # then bisection and relatively robust representations are faster
        values, modes = eigh(reduced, subset_by_index=[0, k - 1]) if few else eigh(reduced, driver="evd")
        vectors = solve_triangular(factor, modes[:, :k], lower=True, trans="T")
    except (np.linalg.LinAlgError, ValueError):
        return np.full(k, np.nan), np.full((k, n), np.nan)
    return values[:k], vectors.T
