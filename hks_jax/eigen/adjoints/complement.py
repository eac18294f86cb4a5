"""The interface of linear solvers for derivatives of eigenpairs, and their common functions, in NumPy or JAX.

Derivatives of eigenpairs need linear solves with K − λᵢM on the M-orthogonal complement of the p lowest eigenvectors.
For every shift σ below the lowest eigenvalue Λ on the complement of the p eigenvectors, K − σM is positive definite on
the complement, even if it is indefinite on the whole space. Preconditioning with K − σM maps the spectrum of K − λᵢM on
the complement to the interval between 1 and (Λ − λᵢ)/(Λ − σ). Each group of right-hand sides with similar λᵢ has its
own shift σ, so that a few factorisations of K − σM suffice for fast convergence. `HostAdjoint` uses SciPy's
factorisations, `FactorisedAdjoint` uses factorisations in JAX, and `FilteredAdjoint` uses a polynomial.
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, Generic

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from hks_jax.checks import require_number
from hks_jax.compilation import library_of
from hks_jax.linear.conjugate_gradients import conjugate_gradients
from hks_jax.linear.operators import OfColumns
from hks_jax.linear.products import even_size, inner_products, matmul, products_with_columns, row_blocks
from hks_jax.linear.symmetric_pencil import P, SymmetricPencil

Array = Any
"""An array of NumPy or JAX. All arguments of a function and its result are arrays of the same library."""
Scalar = Float[Array, ""]
Values = Float[Array, " p"]
"""The p lowest eigenvalues, in ascending order."""
Vectors = Float[Array, "p n_dof"]
"""The M-orthonormal eigenvectors Φ of the p lowest eigenvalues, as rows."""
Rows = Float[Array, "k n_dof"]
"""Right-hand sides or solutions as rows; row i belongs to λᵢ."""
OfRows = Float[Array, " k"]
Columns = Float[Array, "n_dof b"]
Shifts = Float[Array, " groups"]

_SINGULAR = 1e-8
"""The Rayleigh quotient below which K − λᵢM counts as singular, relative to the first eigenvalue on the complement."""
_LEAST = 100
"""In units of ε: the least relative tolerance, and the relative norm at which a projected right-hand side is zero."""
_FACTORISATION = 200
"""Twice the cost of a factorisation of K − σM, in units of one conjugate gradient step for one right-hand side."""
_MOST_GROUPS = 16
_ROWS = 128
"""The number of right-hand sides projected at once; with fewer, the eigenvectors are read from memory more often."""


class Adjoint(eqx.Module, Generic[P]):
    """A linear solver with K − λᵢM on the complement of the computed eigenvectors; all settings are static.

    The field ``adjoint`` of each eigensolver has a default; any `Adjoint` that supports the pencil may replace it.

    Attributes:
        tolerance: the wanted error in the energy norm, relative to the largest right-hand side. Rounding errors of the
            eigenvectors limit the attainable error.
    """

    tolerance: eqx.AbstractVar[float]

    def __check_init__(self) -> None:
        require_number("tolerance", self.tolerance, 1)

    def prepare(self, pencil: P, values: Values, k: int) -> Any:
        """Return the data that `solve` needs for the first k of p eigenvalues and any right-hand sides."""
        return None

    @abstractmethod
    def solve(self, prepared: Any, pencil: P, values: Values, vectors: Vectors, rhs: Rows) -> Rows:
        """Solve (K − λᵢM) xᵢ = Q rhsᵢ with ΦᵀMxᵢ = 0, where Q = I − MΦΦᵀ, p ≥ k and p < n_dof.

        ``prepared`` is the result of `prepare`. Solutions that did not converge are NaN. The method works under `jit`.
        """


def attainable(tolerance: float, dtype: Any) -> float:
    """Return the tolerance, but at least the error caused by rounding of the eigenvectors."""
    return max(tolerance, _LEAST * float(np.finfo(dtype).eps))


def definite_product(
    stiffness: Callable[[Array], Array], mass: Callable[[Array], Array], shifts: Float[Array, " b"], beyond: Scalar
) -> Callable[[Columns], tuple[Columns, Float[Array, " b"]]]:
    """Return the function that maps columns xᵢ to (K − λᵢM) xᵢ, and to the energies xᵢᵀ(K − λᵢM)xᵢ below which the
    matrices K − λᵢM count as singular."""

    def product(x: Columns) -> tuple[Columns, Float[Array, " b"]]:
        image = mass(x)
        return stiffness(x) - shifts[None] * image, _SINGULAR * beyond * (x * image).sum(axis=0)

    return product


def first_beyond(values: Values) -> Scalar:
    """Estimate Λ, the lowest eigenvalue above the computed ones; the largest computed eigenvalue must be positive."""
    return values[-1] * (1 + 1 / values.size)


def amplification(values: Values, k: int) -> OfRows:
    """Return Λ/(Λ − λᵢ): the norm of (K − λᵢM)⁻¹ on the complement, relative to the norm for λᵢ = 0."""
    beyond = first_beyond(values)
    return beyond / (beyond - values[:k])


# The tolerance is relative to the right-hand sides bᵢ before the projection Q = I − MΦΦᵀ. The projections Qbᵢ may be
# pure rounding errors. For example, if the tensors T change by a multiple of T, dK and dM are multiples of K and M, so
# that bᵢ is a multiple of Mφᵢ and Qbᵢ = 0. Rounding errors in Qbᵢ lie mostly in the span of MΦ, so that no solution is
# accurate relative to these errors. Therefore a projection Qbᵢ at the level of rounding counts as zero. Also in reverse
# mode, where bᵢ is a cotangent of φᵢ, the projection Qbᵢ may be pure rounding errors. For example, if the loss is the
# integral of a signature over the domain, bᵢ is a multiple of Mφᵢ.
#
# Right-hand sides need fewer correct digits if they are small, because they contribute little to sums over all i, and
# more if λᵢ is near the lowest eigenvalue Λ on the complement, because (K − λᵢM)⁻¹ amplifies them.
def wanted_errors(before: OfRows, after: OfRows, amplified: OfRows, tolerance: float, dtype: Any) -> OfRows:
    """Return each row's wanted relative error in the energy norm, or infinity for a row that counts as zero.

    Args:
        before: the `norms` of the right-hand sides bᵢ.
        after: the `norms` of the projections Qbᵢ.
        amplified: the `amplification` of each row.
        tolerance: the wanted relative error for the largest right-hand side.
        dtype: the dtype to which eigenvectors and rows were rounded.
    """
    xp, largest = library_of(amplified), before.max()
    share = after / xp.where(largest > 0, largest, 1) * amplified
    noise = (after <= attainable(0, dtype) * before) | (share <= tolerance)
    return xp.where(noise, xp.inf, xp.minimum(tolerance / xp.where(noise, 1, share), 0.1))


def norms(rows: Rows, lumped: Float[Array, " n_dof"]) -> OfRows:
    """Return √(rᵢᵀD⁻¹rᵢ) for each row rᵢ, where D is the lumped mass."""
    xp = library_of(rows)
    return xp.sqrt(xp.sum(rows * rows / lumped[None], axis=1))


def group_numbers(
    distance: Float[np.ndarray, " m"], rows: int, tolerance: float, most: int = _MOST_GROUPS
) -> Int[np.ndarray, " m"]:
    """Divide distances into groups in geometric progression, and return the group of each distance.

    The distance of an eigenvalue λᵢ is Λ − λᵢ, where Λ is the lowest eigenvalue on the complement. If the largest
    distance is ρ times the least, each of s groups has a preconditioned matrix with a condition number of at most
    ρ^(1/2s). The number s minimises the cost of factorisations and of steps for all right-hand sides.
    """
    ratio = max(distance.max() / distance.min(), 1 + 1e-12)

    def cost(s: int) -> float:
        root = ratio ** (1 / (4 * s))
        return s * _FACTORISATION + rows * np.log(2 / tolerance) / np.log((root + 1) / (root - 1))

    count = min(min(range(1, _MOST_GROUPS + 1), key=cost), most)
    return np.minimum((np.log(distance.max() / distance) / np.log(ratio) * count).astype(int), count - 1)


def shifts_between(values: Values, nearest: Shifts, farthest: Shifts) -> Shifts:
    """Return each group's shift: the midpoint of the computed gap whose distance from `first_beyond` is nearest to
    √(``nearest`` · ``farthest``), or a negative number if all eigenvalues are equal."""
    xp = library_of(values)
    targets, below = first_beyond(values) - xp.sqrt(nearest * farthest), -0.1 * values[-1]
    if values.size == 1:
        return xp.broadcast_to(below, targets.shape)
    gaps, typical = xp.diff(values), (values[-1] - values[0]) / (values.size - 1)
    distance = xp.abs((values[:-1] + gaps / 2)[None] - targets[:, None])
    chosen = xp.argmin(xp.where(gaps >= 0.1 * typical, distance, xp.inf), axis=1)
    return xp.where(typical > 0, values[chosen] + gaps[chosen] / 2, below)


def unsolved(failed: int | str, total: int) -> str:
    """Return the message that the linear solves for some eigenpairs did not converge."""
    return (
        f"derivative: the linear solves for {failed} of {total} eigenpairs did not converge, so their derivatives are "
        "NaN. Either k cuts a cluster of eigenvalues, or the eigenpairs did not converge. Use another k or solver, or "
        "set multiplet='drop' in `eigenpairs`"
    )


def without_known(pencil: SymmetricPencil, vectors: Vectors) -> OfColumns:
    """Return the projection x ↦ x − ΦΦᵀMx for columns."""
    mass = pencil.mass.of_columns()
    return lambda x: x - matmul(products_with_columns(vectors, mass(x)).T, vectors).T


# Arrays as large as the eigenvectors are updated in place, because filling a new array of their size takes as long as a
# product with it: the operating system must provide memory.
def projected(
    pencil: SymmetricPencil, vectors: Vectors, rhs: Rows, tolerance: float, amplified: OfRows
) -> tuple[Rows, OfRows]:
    """Return the projections Q rhsᵢ, where Q = I − MΦΦᵀ, and the wanted relative error of each solution."""
    lumped, size = pencil.mass.diagonal(), even_size(len(rhs), _ROWS)
    starts, _ = row_blocks(len(rhs), size)

    # The last two blocks may overlap; to project their common rows twice changes nothing.
    def project(number: Array, rows: tuple[Rows, OfRows]) -> tuple[Rows, OfRows]:
        start = jnp.asarray(starts)[number]
        b = jax.lax.dynamic_slice_in_dim(rows[0], start, size)
        left = b - pencil.mass.apply(matmul(inner_products(vectors, b), vectors))
        after = jax.lax.dynamic_update_slice_in_dim(rows[1], norms(left, lumped), start, axis=0)
        return jax.lax.dynamic_update_slice_in_dim(rows[0], left, start, axis=0), after

    before = norms(rhs, lumped)
    left, after = jax.lax.fori_loop(0, len(starts), project, (rhs, before))
    return left, wanted_errors(before, after, amplified, tolerance, rhs.dtype)


def solve_by_blocks(
    pencil: SymmetricPencil,
    values: Values,
    vectors: Vectors,
    rhs: Rows,
    tolerance: float,
    size: int,  # the number of right-hand sides per block
    first: Int[np.ndarray, " groups"],  # the first row of each group of blocks
    # maps a group, and then its block's part of ``of_rows``, to the function from residuals r to approximations of
    # (K − λᵢM)⁻¹r on the complement; the function must be symmetric and positive definite there, and must not leave it
    preconditioner: Callable[[Int[Array, ""]], Callable[..., OfColumns]],
    *of_rows: OfRows,
    clean: OfColumns | None = None,
) -> Rows:
    """Solve (K − λᵢM) xᵢ = Q rhsᵢ with ΦᵀMxᵢ = 0 in JAX, by conjugate gradients for one block after another.

    See `Adjoint.solve`, and `conjugate_gradients` for ``clean``.
    """
    k, beyond = len(rhs), first_beyond(values)
    stiffness, mass = pencil.stiffness.of_columns(), pencil.mass.of_columns()
    left, wanted = projected(pencil, vectors, rhs, tolerance, amplification(values, k))
    size = min(size, k)
    starts, _ = row_blocks(k, size)
    blocks = jnp.asarray(np.append(first // size, len(starts)))

    def solve_group(group: Array, x: Rows) -> Rows:
        of_block = preconditioner(group)

        def solve_block(number: Array, x: Rows) -> Rows:
            start, rows = jnp.asarray(starts)[number], (x, wanted, values[:k], *of_rows)
            b, error, shifts, *own = (jax.lax.dynamic_slice_in_dim(each, start, size) for each in rows)
            unsolved = start + np.arange(size) >= number * size  # the last two blocks may overlap
            product, error = definite_product(stiffness, mass, shifts, beyond), jnp.where(unsolved, error, jnp.inf)
            solution = conjugate_gradients(product, of_block(*own), b.T, error, clean=clean).converged.T
            return jax.lax.dynamic_update_slice_in_dim(x, jnp.where(unsolved[:, None], solution, b), start, axis=0)

        return jax.lax.fori_loop(blocks[group], blocks[group + 1], solve_block, x)

    return jax.lax.fori_loop(0, len(first), solve_group, left)
