"""The interface that every eigensolver implements."""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar, Generic

import equinox as eqx
from jaxtyping import Array, Float

from hks_jax.checks import require_number
from hks_jax.eigen.complement.adjoint import Adjoint
from hks_jax.eigen.complement.factorised_adjoint import FactorisedAdjoint
from hks_jax.linear.pencil import P

RawPairs = tuple[Float[Array, " k"], Float[Array, "k n_dof"], Float[Array, ""]]

Report = Callable[[str], Any]
"""A function that receives short texts on the progress of a computation. Some of these are a `Status`."""


class Status(str):
    """A text on the progress of a computation, with an estimate of the remaining time.

    Attributes:
        seconds_left: the estimate; None if there is none.
    """

    seconds_left: float | None

    def __new__(cls, text: str, seconds_left: float | None = None) -> "Status":
        """Make the text with the estimate."""
        status = super().__new__(cls, text)
        status.seconds_left = seconds_left
        return status


def silent(text: str) -> None:
    """Ignore the text."""


class Eigensolver(eqx.Module, Generic[P]):
    """A method for the lowest eigenpairs of a symmetric pencil, with its settings (all static).

    Attributes:
        name: the name of the method in reports.
        indefinite: whether it supports an indefinite stiffness, or one with an unknown null space.
        adjoint: the linear solver for derivatives. The default supports every pencil that can be factorised.
        tolerance: the relative residual ‖Kφ − λMφ‖ / ‖Mφ‖ / max(λ, λ₁) at which a pair counts as converged. If the
            level of rounding is larger, it replaces the tolerance.
    """

    name: ClassVar[str]
    indefinite: ClassVar[bool] = True
    tolerance: eqx.AbstractVar[float]
    adjoint: Adjoint = eqx.field(default=FactorisedAdjoint(), static=True, kw_only=True)

    def __check_init__(self) -> None:
        require_number("tolerance", self.tolerance, 1)

    @abstractmethod
    def lowest(self, pencil: P, k: int, report: Report = silent) -> RawPairs:
        """Return the k lowest eigenvalues, ascending, M-orthonormal eigenvectors as rows, and a bound.

        No eigenvalue below the bound was missed, except those after the k-th. Missing pairs are NaN, and the bound is
        NaN if there is no certificate. Works under `jit` and `vmap`. Outside `jit`, it may report progress.
        """

    def guards(self, k: int, n_dof: int) -> int:
        """Return the number of pairs beyond k to compute for derivatives."""
        return 8 + k // 50

    def max_pairs(self, n_dof: int) -> int:
        """Return the largest k that the method supports for n_dof degrees of freedom."""
        return n_dof
