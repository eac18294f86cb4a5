"""The interface of all eigensolvers, and the dense solver, which is the reference for the other solvers."""

from abc import abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar, Generic

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.linalg import cholesky, eigh, solve_triangular

from hks_jax.checks import require_number
from hks_jax.compilation import is_concrete_on_cpu
from hks_jax.eigen.adjoints.complement import Adjoint
from hks_jax.eigen.adjoints.factorised_adjoint import FactorisedAdjoint
from hks_jax.linear.dense_eigh import pencil_eigh
from hks_jax.linear.host_matrices import host_matrices
from hks_jax.linear.symmetric_pencil import P, SymmetricPencil

_FAR = 30
"""The largest distance of an origin below the wanted eigenvalues, in units of the spread of these eigenvalues."""

RawPairs = tuple[Float[Array, " k"], Float[Array, "m n_dof"], Float[Array, ""]]

Report = Callable[[str], Any]
"""A function that receives short texts on the progress of a computation. Some texts are of the class `Status`."""


class Status(str):
    """A text on the progress of a computation, with an estimate of the remaining time.

    Attributes:
        seconds_left: the estimate; None if it is unknown.
    """

    seconds_left: float | None

    def __new__(cls, text: str, seconds_left: float | None = None) -> "Status":
        """Make a progress text with an estimate of the remaining seconds."""
        status = super().__new__(cls, text)
        status.seconds_left = seconds_left
        return status


def is_remote(values: Float[Array | np.ndarray, " k"], rounding: Float[Array, ""] | float) -> bool:
    """Return whether to solve again from an origin nearer to the spectrum, given the eigenvalues' distances from it.

    Distances from a remote origin have fewer correct digits. If all eigenvalues are equal within rounding, the lost
    digits do not matter. Values must be concrete.
    """
    spread = values[-1] - values[0]
    return bool(spread > rounding and values[0] > _FAR * spread)


def silent(text: str) -> None:
    """Ignore the text."""


class Eigensolver(eqx.Module, Generic[P]):
    """A method for the lowest eigenpairs of a symmetric pencil, with its settings (all static).

    Attributes:
        name: the name of the method in reports.
        starts: whether `lowest` has the argument ``start``: approximate eigenvectors (m, n_dof) to start from, or None.
        in_double: whether the method computes in float64 if values are concrete and on a CPU, whatever their dtype.
        adjoint: the linear solver for derivatives. The default, `FactorisedAdjoint`, needs a pencil that it can
            factorise.
        tolerance: the relative residual ‖Kφ − λMφ‖ / ‖Mφ‖ / max(λ, λ₁) at which a pair counts as converged, or the
            level of rounding if that is larger.
    """

    name: ClassVar[str]
    starts: ClassVar[bool] = False
    in_double: ClassVar[bool] = False
    tolerance: eqx.AbstractVar[float]
    adjoint: Adjoint = eqx.field(default=FactorisedAdjoint(), static=True, kw_only=True)

    def __check_init__(self) -> None:
        require_number("tolerance", self.tolerance, 1)

    @abstractmethod
    def lowest(self, pencil: P, k: int, report: Report = silent) -> RawPairs:
        """Return the k lowest eigenvalues (ascending), M-orthonormal eigenvectors (as rows), and a certified bound.

        None of the k lowest eigenvalues is missing below the bound. Pairs that were not found are NaN, and the bound is
        NaN if there is no certificate. Further vectors may follow the k eigenvectors; `PencilEigenpairs.spare` keeps
        them. The method works under `jit` and `vmap`; outside `jit`, it may report progress.
        """

    def require(self, pencil: P) -> None:
        """Raise ValueError unless the method supports the pencil."""

    def guards(self, k: int, n_dof: int) -> int:
        """Return the number of pairs beyond k to compute for derivatives."""
        return 8 + k // 50

    def max_pairs(self, n_dof: int) -> int:
        """Return the largest k that the method supports for n_dof degrees of freedom."""
        return n_dof


class Dense(Eigensolver[SymmetricPencil]):
    """The dense solver, which misses no eigenvalue: `eigh` of L⁻¹KL⁻ᵀ, where M = LLᵀ, in O(n³) time and O(n²) memory.

    Examples:
        >>> flat = hj.TensorField(field.grid, np.tile(np.eye(2), (9, 9, 1, 1)))
        >>> print((hj.eigenpairs(flat, k=4, solver=hj.Dense()).eigenvalues / jnp.pi**2).round(1))
        [0. 1. 1. 2.]
    """

    name: ClassVar[str] = "dense"
    in_double: ClassVar[bool] = True
    tolerance: float = eqx.field(default=1e-8, static=True)

    def lowest(self, pencil: SymmetricPencil, k: int, report: Report = silent) -> RawPairs:
        """Return the k lowest eigenpairs, which SciPy computes without compilation if values are concrete."""
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
        few = 3 * k < n  # for few pairs, LAPACK's driver `evr` is faster
        values, modes = eigh(reduced, subset_by_index=[0, k - 1]) if few else eigh(reduced, driver="evd")
        vectors = solve_triangular(factor, modes[:, :k], lower=True, trans="T")
    except (np.linalg.LinAlgError, ValueError):
        return np.full(k, np.nan), np.full((k, n), np.nan)
    return values[:k], vectors.T
