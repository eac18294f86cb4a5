"""A pair of symmetric matrices, of which one is positive definite: what eigensolvers know of a problem."""

import equinox as eqx
from jaxtyping import Array, Float

from hks_jax.linear.operators import Operator, PatternedOperator, shifted
from hks_jax.linear.pattern import Pattern


class SymmetricPencil(eqx.Module):
    """The stiffness K and mass M of Kφ = λMφ, symmetric, M ≻ 0.

    Attributes:
        stiffness: K; multiply with ``@``, or take ``.to_scipy()``, ``.to_dense()``.
        mass: M, likewise. It has no entries where K has none.
    """

    stiffness: PatternedOperator
    mass: Operator

    @property
    def size(self) -> int:
        """The number of degrees of freedom."""
        return self.stiffness.size

    @property
    def pattern(self) -> Pattern:
        """Where K has entries."""
        return self.stiffness.pattern

    @property
    def n_null(self) -> int:
        """How many null vectors of K are known beforehand."""
        return 0

    @property
    def parts(self) -> tuple["SymmetricPencil", ...]:
        """The pencil itself: one problem."""
        return (self,)

    def shifted(self, shift: Float[Array, ""]) -> Float[Array, " m"]:
        """Return the entries of K − σM at the places of K's pattern."""
        return shifted(self.stiffness, self.mass, shift)
