"""Factorisation of K − σM: a function for users, and a linear solver for lineax."""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx  # type: ignore[import-untyped]
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Inexact

from hks_jax.checks import require_number
from hks_jax.fem.assembly import MassKind
from hks_jax.fem.boundary import BoundarySpec
from hks_jax.fem.pencil import Pencil
from hks_jax.fem.sparse_input import pencil_of, sparse_pencil
from hks_jax.linear.factorised_matrix import FactorisedMatrix, factorised
from hks_jax.linear.operators import PatternedOperator, SparseOperator
from hks_jax.linear.pattern import SparsePattern


def factorise(
    domain: Any,
    shift: Float[Array, ""] | float = 0.0,
    boundary: BoundarySpec = "neumann",
    mass: MassKind = "consistent",
) -> FactorisedMatrix:
    """Factorise A = K − σM for ``.solve(b)``, ``.logdet()``, ``.inertia`` and ``.inverse_diagonal()``.

    The matrix A may be indefinite. All results are differentiable with respect to K, M, σ and right-hand sides, in
    forward and reverse mode to any order, under `jit` and `vmap`. The elimination is a multifrontal LDLᵀ along a nested
    dissection, without pivoting across fronts. The accuracy is tested on random right-hand sides. If small pivots make
    the elimination inaccurate, it is repeated with larger pivots in their place, and solutions are refined iteratively.
    If values are traced, results of a singular matrix are NaN, and ``.sound`` is False.

    Args:
        domain: a tensor field, a mesh, a pencil, a symmetric sparse matrix K (then M is the identity), or (K, M), as
            for `eigenpairs`.
        shift: the shift σ.
        boundary: see `assemble`; leave it out for a pencil or matrices.
        mass: see `assemble`; leave it out for a pencil or matrices.

    Raises:
        ValueError: a shift that is not a finite number; a singular matrix (the message has the number of null vectors);
            a domain that `eigenpairs` refuses; a doubled domain.

    Examples:
        >>> A = hj.factorise(np.array([[2.0, 1.0], [1.0, 2.0]]))
        >>> print(A.solve(jnp.array([3.0, 3.0])).round(), jnp.exp(A.logdet()).round())
        [1. 1.] 3.0
    """
    return factorised(_shifted(domain, shift, boundary, mass), "domain: K − σM")


def _shifted(domain: Any, shift: Any, boundary: BoundarySpec, mass: MassKind) -> PatternedOperator:
    require_number("shift", shift, above=-math.inf)
    pencil = pencil_of(domain, boundary, mass)
    if not isinstance(pencil, Pencil):
        raise ValueError(
            'domain: got "mirror" or "mean", which give several matrices; factorise each of `assemble(…).parts`'
        )
    return pencil.stiffness.with_flat(pencil.shifted(jnp.asarray(shift, pencil.stiffness.dtype)))


class SparseLinearOperator(lx.AbstractLinearOperator):
    """The symmetric matrix K − σM as a linear operator of lineax, on vectors (n,).

    Attributes:
        matrix: the sparse matrix.

    Examples:
        >>> A = hj.SparseLinearOperator(np.array([[2.0, 1.0], [1.0, 2.0]]), shift=1.0)
        >>> print(A.mv(jnp.array([1.0, 2.0])))
        [3. 3.]
    """

    matrix: PatternedOperator

    def __init__(self, domain: Any, shift: Float[Array, ""] | float = 0.0) -> None:
        """Assemble K − σM, with arguments and errors as for `factorise`. Entries may be traced, but not indices."""
        self.matrix = _shifted(domain, shift, "neumann", "consistent")

    def mv(self, vector: Float[Array, " n"]) -> Float[Array, " n"]:
        """Return the product with a vector."""
        return self.matrix @ vector

    def as_matrix(self) -> Float[Array, "n n"]:
        """Return the full matrix."""
        return self.matrix.to_dense()

    def transpose(self) -> "SparseLinearOperator":
        """Return the operator itself."""
        return self

    def in_structure(self) -> jax.ShapeDtypeStruct:
        """Return the shape and dtype of vectors."""
        return jax.ShapeDtypeStruct((self.matrix.size,), self.matrix.dtype)

    def out_structure(self) -> jax.ShapeDtypeStruct:
        """Return the shape and dtype of products."""
        return self.in_structure()


def _tridiagonal(operator: SparseLinearOperator) -> tuple[Array, Array, Array]:
    entries, (rows, cols) = operator.matrix.triplets()
    n, result = operator.matrix.size, []
    for offset in (0, -1, 1):
        on = np.flatnonzero(cols - rows == offset)
        result.append(jnp.zeros(n - abs(offset), entries.dtype).at[np.minimum(rows, cols)[on]].add(entries[on]))
    return result[0], result[1], result[2]


for _itself in (lx.linearise, lx.materialise, lx.conj):
    _itself.register(SparseLinearOperator)(lambda operator: operator)
lx.diagonal.register(SparseLinearOperator)(lambda operator: operator.matrix.diagonal())
lx.tridiagonal.register(SparseLinearOperator)(_tridiagonal)
lx.is_symmetric.register(SparseLinearOperator)(lambda _: True)
for _unknown in (
    lx.is_diagonal,
    lx.is_tridiagonal,
    lx.has_unit_diagonal,
    lx.is_lower_triangular,
    lx.is_upper_triangular,
    lx.is_positive_semidefinite,
    lx.is_negative_semidefinite,
):
    _unknown.register(SparseLinearOperator)(lambda _: False)


class _State(eqx.Module):
    """A factorised operator A."""

    factor: FactorisedMatrix  # the factors of A, or of a real matrix of twice the size if A is complex
    hermitian: bool | None = eqx.field(static=True)  # whether a complex A is Hermitian, not symmetric; None if real
    conjugate: bool = eqx.field(static=True, default=False)  # whether `solve` uses the conjugate of A

    def conjugated(self) -> "_State":
        return _State(self.factor, self.hermitian, self.hermitian is not None and not self.conjugate)

    # For A = R + iS, x = u + iv and b = c + id, the complex system A x = b stands for two real systems, R u − S v = c
    # and S u + R v = d. If A is Hermitian, S is antisymmetric, and the block matrix of the two real systems is
    # symmetric. If A is symmetric, the block matrix becomes symmetric when the second real system changes sign.
    def solve(self, b: Inexact[Array, " n"]) -> Inexact[Array, " n"]:
        if self.hermitian is None:
            return self.factor.solve(b)
        b = b.conj() if self.conjugate else b
        parts = self.factor.solve(jnp.concatenate([b.real, b.imag if self.hermitian else -b.imag]))
        x = jax.lax.complex(parts[: b.size], parts[b.size :])
        return x.conj() if self.conjugate else x


class Multifrontal(lx.AbstractLinearSolver[_State]):
    """The factorisation of `factorise` as a solver of lineax, for symmetric and Hermitian operators, definite or not.

    A `SparseLinearOperator`, multiples and sums of such operators, and real tridiagonal operators are factorised as
    sparse matrices. All other operators are converted by ``as_matrix`` and take n³ operations; a complex operator takes
    as many operations as a real operator of twice the size. Lineax defines the derivatives. The matrix must be
    nonsingular.

    Examples:
        >>> import lineax
        >>> A = hj.SparseLinearOperator(np.array([[2.0, 1.0], [1.0, 2.0]]))
        >>> print(lineax.linear_solve(A, jnp.array([3.0, 3.0]), hj.Multifrontal()).value.round(3))
        [1. 1.]
    """

    def init(self, operator: lx.AbstractLinearOperator, options: dict[str, Any]) -> _State:
        """Factorise an operator.

        Raises:
            ValueError: an operator that is neither symmetric nor Hermitian.
        """
        definite = lx.is_positive_semidefinite(operator) or lx.is_negative_semidefinite(operator)
        if not (lx.is_symmetric(operator) or definite):
            raise ValueError(
                "operator: got an operator that is not known to be symmetric or Hermitian; if it is, add a tag, such "
                "as `lineax.TaggedLinearOperator(operator, lineax.symmetric_tag)`, or use `lineax.LU`"
            )
        if not jnp.issubdtype(jnp.result_type(*jax.tree.leaves(operator.in_structure())), jnp.complexfloating):
            return _State(factorised(_patterned(operator), "operator"), None)
        hermitian, full = not lx.is_symmetric(operator), operator.as_matrix()
        real, imaginary = full.real, full.imag
        below = [imaginary, real] if hermitian else [-imaginary, -real]
        return _State(factorised(_full(jnp.block([[real, -imaginary], below])), "operator"), hermitian)

    def compute(self, state: _State, vector: Any, options: dict[str, Any]) -> tuple[Any, lx.RESULTS, dict[str, Any]]:
        """Solve with a factorised operator. If the operator is singular, the solution is NaN, which lineax reports."""
        flat, unflatten = ravel_pytree(vector)
        return unflatten(state.solve(flat)), lx.RESULTS.successful, {}

    def transpose(self, state: _State, options: dict[str, Any]) -> tuple[_State, dict[str, Any]]:
        """Return the state of the transposed operator."""
        return (state.conjugated() if state.hermitian else state), options

    def conj(self, state: _State, options: dict[str, Any]) -> tuple[_State, dict[str, Any]]:
        """Return the state of the conjugate operator."""
        return state.conjugated(), options

    def assume_full_rank(self) -> bool:
        """Return True."""
        return True


def _patterned(operator: Any) -> PatternedOperator:
    match operator:
        case SparseLinearOperator():
            return operator.matrix
        case lx.TaggedLinearOperator():
            return _patterned(operator.operator)
        case lx.NegLinearOperator():
            return _multiple(_patterned(operator.operator), -1)
        case lx.MulLinearOperator():
            return _multiple(_patterned(operator.operator), operator.scalar)
        case lx.DivLinearOperator():
            return _multiple(_patterned(operator.operator), 1 / operator.scalar)
        case lx.AddLinearOperator():
            one, other = _patterned(operator.operator1), _patterned(operator.operator2)
            both = sparse_pencil(one, other)
            return both.stiffness.with_flat(both.shifted(jnp.asarray(-1, one.dtype)))
    if not lx.is_tridiagonal(operator):
        return _full(operator.as_matrix())
    entries, index = lx.tridiagonal(operator), np.arange(operator.in_size())
    rows, cols = np.concatenate([index, index[1:], index[:-1]]), np.concatenate([index, index[:-1], index[1:]])
    order = np.lexsort((cols, rows))
    return SparseOperator(jnp.concatenate(entries)[order], SparsePattern(index.size, rows[order], cols[order]))


def _multiple(matrix: PatternedOperator, scalar: Any) -> PatternedOperator:
    return matrix.with_flat(matrix.flat() * jnp.asarray(scalar, matrix.dtype))


def _full(matrix: Float[Array, "n n"]) -> SparseOperator:
    n = len(matrix)
    rows, cols = np.divmod(np.arange(n * n), n)
    return SparseOperator(matrix.reshape(-1), SparsePattern(n, rows, cols))
