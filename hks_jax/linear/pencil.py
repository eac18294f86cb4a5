"""A pair of symmetric matrices, of which one is positive definite: what eigensolvers know of a problem."""

from typing import TypeVar

import equinox as eqx
import jax
from jaxtyping import Array, Float

from hks_jax.linear.operators import Operator, PatternedOperator, SparseOperator, shifted
from hks_jax.linear.pattern import Pattern, SparsePattern


class NullSpace(eqx.Module):
    """The null space of a stiffness K ⪰ 0, all of it.

    Attributes:
        vectors: (m, n_dof) a basis; m may be 0.
        fixed: whether every perturbation of K annihilates it too, as of stiffness matrices of elements. Derivatives
            then leave out what only rounding could contribute.
    """

    vectors: Float[Array, "m n_dof"]
    fixed: bool = eqx.field(default=False, static=True)


class SymmetricPencil(eqx.Module):
    """The stiffness K and mass M of Kφ = λMφ, symmetric, M ≻ 0.

    Attributes:
        stiffness: K; multiply with ``@``, or take ``.to_scipy()``, ``.to_dense()``.
        mass: M, likewise. It has no entries where K has none.
        null_space: that of K ⪰ 0; None where nothing is known, and K may be indefinite.
    """

    stiffness: PatternedOperator
    mass: Operator
    null_space: NullSpace | None = eqx.field(default=None, kw_only=True)

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
        return 0 if self.null_space is None else len(self.null_space.vectors)

    @property
    def n_fixed(self) -> int:
        """How many of them every perturbation of K annihilates, too."""
        return self.n_null if self.null_space is not None and self.null_space.fixed else 0

    @property
    def parts(self) -> tuple["SymmetricPencil", ...]:
        """The pencil itself: one problem."""
        return (self,)

    def shifted(self, shift: Float[Array, ""]) -> Float[Array, " m"]:
        """Return the entries of K − σM at the places of K's pattern."""
        return shifted(self.stiffness, self.mass, shift)


P = TypeVar("P", bound=SymmetricPencil)
"""Any pencil, or those of a domain, or of a grid."""


def tabulated(pencil: P) -> P:
    """Return a pencil with what products need of a sparse pattern as arrays, to hand over to several computations."""
    pattern = pencil.pattern
    if not isinstance(pattern, SparsePattern):
        return pencil
    table = jax.device_put(pattern.table)
    operators = tuple(
        SparseOperator(operator.entries, pattern, table) if isinstance(operator, SparseOperator) else operator
        for operator in (pencil.stiffness, pencil.mass)
    )
    return eqx.tree_at(lambda p: (p.stiffness, p.mass), pencil, operators)
