"""The interface that every eigensolver implements."""

from abc import abstractmethod
from typing import ClassVar

import equinox as eqx
from jaxtyping import Array, Float

from hks_jax.fem.pencil import Pencil

RawPairs = tuple[Float[Array, " k"], Float[Array, "k n_dof"]]


class Eigensolver(eqx.Module):
    """A method for the lowest eigenpairs of a symmetric pencil, with its settings (all static).

    Attributes:
        name: what reports call the method.
        tolerance: the relative residual ‖Kφ − λMφ‖ / ‖Mφ‖ / max(λ, λ₁) at which a pair counts as converged, unless
            rounding in the matrices' dtype forbids it.
    """

    name: ClassVar[str]
    tolerance: eqx.AbstractVar[float]

    @abstractmethod
    def lowest(self, pencil: Pencil, k: int) -> RawPairs:
        """Return the k lowest eigenvalues, ascending, and M-orthonormal eigenvectors as rows.

        What was not found is NaN. Traceable: works under `jit` and `vmap`.
        """

    def max_pairs(self, n_dof: int) -> int:
        """Return the largest k that the method can deliver for n_dof degrees of freedom."""
        return n_dof
