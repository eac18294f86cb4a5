"""The interface of what derivatives of eigenpairs solve with."""

from abc import abstractmethod
from typing import Any, ClassVar, Generic, TypeVar

import equinox as eqx
from jaxtyping import Array, Float

from hks_jax.checks import require_number
from hks_jax.linear.pencil import SymmetricPencil

P = TypeVar("P", bound=SymmetricPencil)
"""What it solves with: any pencil, or those of a domain, or of a grid."""


class Adjoint(eqx.Module, Generic[P]):
    """How derivatives solve with K − λᵢM on the complement of the computed eigenvectors; all settings static.

    Every eigensolver has one in its field ``adjoint``, and takes any other that can solve with the pencil.

    Attributes:
        warns: whether `solve` itself warns of what does not converge, traced or not.
        tolerance: to what the error is reduced, in the energy norm, relative to the largest row; not below what the
            eigenvectors' dtype allows.
    """

    warns: ClassVar[bool] = False
    tolerance: eqx.AbstractVar[float]

    def __check_init__(self) -> None:
        """Check the tolerance."""
        require_number("tolerance", self.tolerance, 1)

    def prepare(self, pencil: P, values: Float[Array, " p"], k: int) -> Any:
        """Return what `solve` for the first k of p eigenvalues needs and no right-hand side changes."""
        return None

    @abstractmethod
    def solve(
        self,
        prepared: Any,
        pencil: P,
        values: Float[Array, " p"],
        vectors: Float[Array, "p n_dof"],
        rhs: Float[Array, "k n_dof"],
    ) -> Float[Array, "k n_dof"]:
        """Solve (K − λᵢM) xᵢ = Q rhsᵢ with ΦᵀMxᵢ = 0, where Q = I − MΦΦᵀ, p ≥ k and p < n_dof.

        Args:
            prepared: from `prepare`.
            pencil: K and M.
            values: (p,) the lowest eigenvalues, ascending.
            vectors: (p, n_dof) their M-orthonormal eigenvectors Φ.
            rhs: (k, n_dof); row i belongs to λᵢ.

        Returns:
            (k, n_dof). What did not converge is NaN. Traceable.
        """
