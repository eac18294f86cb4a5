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
"""Told in short texts how far a computation is; some of them are a `Status`."""


class Status(str):
    """A text that says how far a computation is, with how long the rest takes.

    Attributes:
        seconds_left: an estimate; None where there is none.
    """

    seconds_left: float | None

    def __new__(cls, text: str, seconds_left: float | None = None) -> "Status":
        """Return the text with the estimate."""
        status = super().__new__(cls, text)
        status.seconds_left = seconds_left
        return status


def silent(text: str) -> None:
    """Say nothing."""


class Eigensolver(eqx.Module, Generic[P]):
    """A method for the lowest eigenpairs of a symmetric pencil, with its settings (all static).

    Attributes:
        name: what reports call the method.
        indefinite: whether it takes pencils of whose null space nothing is known.
        adjoint: what derivatives solve linear systems with; by default for any pencil that can be factorised.
        tolerance: the relative residual ‖Kφ − λMφ‖ / ‖Mφ‖ / max(λ, λ₁) at which a pair counts as converged, unless
            rounding in the matrices' dtype forbids it.
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

        Every eigenvalue below the bound is certainly among the k, or beyond them. What was not found is NaN, and so is
        the bound where nothing is certain. Traceable: works under `jit` and `vmap`. Called plainly, it may report
        progress.
        """

    def guards(self, k: int, n_dof: int) -> int:
        """Return how many pairs beyond k to compute where derivatives are wanted."""
        return 8 + k // 50

    def max_pairs(self, n_dof: int) -> int:
        """Return the largest k that the method can deliver for n_dof degrees of freedom."""
        return n_dof
