"""The interface that every eigensolver implements."""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar, Generic, TypeVar

import equinox as eqx
from jaxtyping import Array, Float

from hks_jax.linear.pencil import SymmetricPencil

P = TypeVar("P", bound=SymmetricPencil)
"""What a method can solve: any pencil, or those of a domain, or of a grid."""

RawPairs = tuple[Float[Array, " k"], Float[Array, "k n_dof"], Float[Array, ""]]

Report = Callable[[str], Any]
"""Told in short texts how far a computation is."""


def silent(text: str) -> None:
    """Say nothing."""


class Eigensolver(eqx.Module, Generic[P]):
    """A method for the lowest eigenpairs of a symmetric pencil, with its settings (all static).

    Attributes:
        name: what reports call the method.
        warns: whether `solve_complement` warns of what does not converge, traced or not.
        tolerance: the relative residual ‖Kφ − λMφ‖ / ‖Mφ‖ / max(λ, λ₁) at which a pair counts as converged, unless
            rounding in the matrices' dtype forbids it.
    """

    name: ClassVar[str]
    warns: ClassVar[bool] = False
    tolerance: eqx.AbstractVar[float]

    @abstractmethod
    def lowest(self, pencil: P, k: int, report: Report = silent) -> RawPairs:
        """Return the k lowest eigenvalues, ascending, M-orthonormal eigenvectors as rows, and a bound.

        Every eigenvalue below the bound is certainly among the k, or beyond them. What was not found is NaN, and so is
        the bound where nothing is certain. Traceable: works under `jit` and `vmap`. Called plainly, it may report
        progress.
        """

    def prepare_complement(self, pencil: P, values: Float[Array, " p"], k: int) -> Any:
        """Return what `solve_complement` for the first k of p eigenvalues needs and no right-hand side changes."""
        return None

    def solve_complement(
        self,
        prepared: Any,
        pencil: P,
        values: Float[Array, " p"],
        vectors: Float[Array, "p n_dof"],
        rhs: Float[Array, "k n_dof"],
    ) -> Float[Array, "k n_dof"]:
        """Solve (K − λᵢM) xᵢ = (I − MΦΦᵀ) rhsᵢ with ΦᵀMxᵢ = 0, Φ the p ≥ k given eigenvectors, p < n_dof.

        Derivatives need it, unless `guards` are all the other pairs. What did not converge is NaN. Traceable.
        """
        raise NotImplementedError(
            f"eigenpairs: the {self.name} solver has no solve_complement, which derivatives need; use another solver"
        )

    def guards(self, k: int, n_dof: int) -> int:
        """Return how many pairs beyond k to compute where derivatives are wanted."""
        return 8 + k // 20

    def max_pairs(self, n_dof: int) -> int:
        """Return the largest k that the method can deliver for n_dof degrees of freedom."""
        return n_dof
