"""Symmetric definite pencils (K, M), the input of eigensolvers."""

from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hks_jax.linear.operators import Operator, PatternedOperator, SparseOperator, shifted
from hks_jax.linear.pattern import Pattern, SparsePattern
from hks_jax.linear.products import of_each_column


class NullSpace(eqx.Module):
    """The complete null space of a stiffness K ⪰ 0.

    Attributes:
        vectors: a basis (m, n_dof); m may be 0.
        fixed: whether every perturbation of K annihilates the null space too, as for finite-element stiffness matrices.
            If ``fixed`` is true, derivatives omit the products of perturbations and null vectors.
    """

    vectors: Float[Array, "m n_dof"]
    fixed: bool = eqx.field(default=False, static=True)


class Unrounded(eqx.Module):
    """A stiffness K − σM before its entries are rounded, for computations on the host; constant in derivatives.

    Attributes:
        stiffness: K.
        origin: σ.
        null_vectors: vectors (m, n_dof) that K annihilates except for rounding; m may be 0.
    """

    stiffness: PatternedOperator
    origin: Float[Array, ""]
    null_vectors: Float[Array, "m n_dof"]


class SymmetricPencil(eqx.Module):
    """The stiffness K and mass M of Kφ = λMφ. The matrices K and M are symmetric, and M ≻ 0.

    Attributes:
        stiffness: K; use ``@`` for products, ``.to_scipy()`` and ``.to_dense()`` for conversion.
        mass: M, an operator like K. The sparsity pattern of K contains the pattern of M.
        null_space: the null space of K ⪰ 0. None means that the null space is unknown and K may be indefinite.
        source: what K was before rounding, if that is more than K; otherwise None.
    """

    stiffness: PatternedOperator
    mass: Operator
    null_space: NullSpace | None = eqx.field(default=None, kw_only=True)
    source: Unrounded | None = eqx.field(default=None, kw_only=True)

    @property
    def size(self) -> int:
        """The number of degrees of freedom."""
        return self.stiffness.size

    @property
    def pattern(self) -> Pattern:
        """The sparsity pattern of K."""
        return self.stiffness.pattern

    @property
    def n_null(self) -> int:
        """The dimension of the known null space of K; 0 if it is unknown."""
        return 0 if self.null_space is None else len(self.null_space.vectors)

    @property
    def n_fixed(self) -> int:
        """The number of null vectors that every perturbation of K annihilates."""
        return self.n_null if self.null_space is not None and self.null_space.fixed else 0

    @property
    def unrounded(self) -> Unrounded:
        """The stiffness before rounding, and its null vectors as far as they are known."""
        if self.source is not None:
            return self.source
        dtype = self.stiffness.dtype
        nulls = jnp.zeros((0, self.size), dtype) if self.null_space is None else self.null_space.vectors
        return jax.lax.stop_gradient(Unrounded(self.stiffness, jnp.zeros((), dtype), nulls))

    def moved_by(self, origin: Float[Array, ""]) -> tuple[PatternedOperator, Unrounded]:
        """Return K − σM for an origin σ, rounded and unrounded."""
        before, origin_only = self.unrounded, jax.lax.stop_gradient(origin)
        moved = self.stiffness.with_flat(self.shifted(origin))
        return moved, Unrounded(before.stiffness, before.origin + origin_only, before.null_vectors)

    def shifted(self, shift: Float[Array, ""]) -> Float[Array, " m"]:
        """Return the entries of K − σM at the places of K's pattern."""
        return shifted(self.stiffness, self.mass, shift)


# If all entries Kᵢⱼ are rounded and wᵢ are the sums of rows, the changes of Kᵢⱼ and wᵢ change the quadratic form
#
#     φᵀKφ = −Σ_{i<j} Kᵢⱼ (φᵢ − φⱼ)² + Σᵢ wᵢφᵢ².
#
# With the sums Sᵢ = Σⱼ |Kᵢⱼ|, relative changes up to ε change the first term by at most ε(Σᵢ Sᵢφᵢ² − φᵀ|K|φ), and the
# second by at most ε Σᵢ Sᵢφᵢ². A sum wᵢ that is known to be zero, because K annihilates constants, does not change.
def change_by_rounding(image: Any, weights: Any, columns: Any) -> Any:
    """Return a bound of the change of φᵀKφ by rounding, divided by ε, for each column φ.

    ``image`` is |K|φ. ``weights`` are 2Sᵢ, or Sᵢ at nodes i where the sum of the row is known to be zero.
    """
    return of_each_column(columns, weights[:, None] * columns - image)


P = TypeVar("P", bound=SymmetricPencil)
"""The type of pencil that a solver supports: any pencil, or pencils assembled on a domain, or on a grid."""


def tabulated(pencil: P) -> P:
    """Return the pencil with the pattern's tables as arrays, which several compiled functions can share."""
    pattern = pencil.pattern
    if not isinstance(pattern, SparsePattern):
        return pencil
    table = jax.device_put(pattern.table)
    operators = tuple(
        SparseOperator(operator.entries, pattern, table) if isinstance(operator, SparseOperator) else operator
        for operator in (pencil.stiffness, pencil.mass)
    )
    return eqx.tree_at(lambda p: (p.stiffness, p.mass), pencil, operators)
