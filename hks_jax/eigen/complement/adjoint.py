"""What derivatives of eigenpairs solve with: the interface, and what its methods have in common, in NumPy or in JAX.

The derivatives of a truncated spectrum need them. On the M-orthogonal complement of the p lowest eigenvectors K − λᵢM
is positive definite, and so is K − σM for *every* σ below the next eigenvalue Λ, whatever its sign elsewhere.
Preconditioned with it, the spectrum of conjugate gradients lies between 1 and (Λ − λᵢ)/(Λ − σ). So the rows are grouped
by their λᵢ, each group has its own shift σ among them, and a few factorisations bring every row to convergence in a few
steps. `HostAdjoint` does so with SciPy's factorisations, `FactorisedAdjoint` with those in JAX; `FilteredAdjoint` has a
polynomial instead.
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar, Generic

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from hks_jax.checks import require_number
from hks_jax.linear.operators import OfColumns
from hks_jax.linear.pencil import P, SymmetricPencil
from hks_jax.linear.products import even_size, inner_products, matmul, products_with_columns, row_blocks

Array = Any
"""NumPy's or JAX's, the same for all arguments and the result."""
Scalar = Float[Array, ""]
Values = Float[Array, " p"]
"""The p computed eigenvalues, the lowest, ascending."""
Vectors = Float[Array, "p n_dof"]
"""Their M-orthonormal eigenvectors Φ."""
Rows = Float[Array, "k n_dof"]
"""Right-hand sides or solutions; row i belongs to λᵢ."""
OfRows = Float[Array, " k"]
Columns = Float[Array, "n_dof b"]
Shifts = Float[Array, " groups"]

SINGULAR = 1e-8
"""The gap, relative to the last eigenvalue, below which K − λᵢM counts as singular on the complement."""
_LEAST = 100
"""The size of a row that vanishes but for rounding, in units of ε times its former size; and the finest tolerance."""
_FACTORISATION = 200
"""What one factorisation costs, in solves of one row: about 100, doubled as small rows take few steps."""
_MOST_GROUPS = 16
_ROWS = 128
"""Rows that the known eigenvectors are taken out of at once: fewer read them more often from memory."""


class Adjoint(eqx.Module, Generic[P]):
    """How derivatives solve with K − λᵢM on the complement of the computed eigenvectors; all settings static.

    Every eigensolver has one in its field ``adjoint``, and takes any other that can solve with the pencil.

    Attributes:
        warns: whether `solve` itself warns of rows that do not converge, traced or not.
        tolerance: of the error in the energy norm, relative to the largest row; not below what the
            eigenvectors' dtype allows.
    """

    warns: ClassVar[bool] = False
    tolerance: eqx.AbstractVar[float]

    def __check_init__(self) -> None:
        require_number("tolerance", self.tolerance, 1)

    def prepare(self, pencil: P, values: Values, k: int) -> Any:
        """Return what `solve` for the first k of p eigenvalues needs and no right-hand side changes."""
        return None

    @abstractmethod
    def solve(self, prepared: Any, pencil: P, values: Values, vectors: Vectors, rhs: Rows) -> Rows:
        """Solve (K − λᵢM) xᵢ = Q rhsᵢ with ΦᵀMxᵢ = 0, where Q = I − MΦΦᵀ, p ≥ k and p < n_dof.

        `prepare` has prepared it. What did not converge is NaN. Traceable.
        """


def attainable(tolerance: float, dtype: Any) -> float:
    """Return the tolerance, or what rounded eigenvectors allow if that is more: beyond it is noise."""
    return max(tolerance, _LEAST * float(np.finfo(dtype).eps))


def definite_product(
    stiffness: Callable[[Array], Array], mass: Callable[[Array], Array], shifts: Float[Array, " b"], beyond: Scalar
) -> Callable[[Columns], tuple[Columns, Float[Array, " b"]]]:
    """Return x ↦ (K − λᵢM) xᵢ, with the energy below which an eigenvalue equal to λᵢ is left on the complement."""

    def product(x: Columns) -> tuple[Columns, Float[Array, " b"]]:
        image = mass(x)
        return stiffness(x) - shifts[None] * image, SINGULAR * beyond * (x * image).sum(axis=0)

    return product


def first_beyond(values: Values) -> Scalar:
    """Return an estimate Λ of the first eigenvalue that is left; the last of the known ones is positive."""
    return values[-1] * (1 + 1 / values.size)


def amplification(values: Values, k: int) -> OfRows:
    """Return the norms Λ/(Λ − λᵢ), relative to that for λ = 0, of the inverses on the complement."""
    beyond = first_beyond(values)
    return beyond / (beyond - values[:k])


# The accuracy asked for is relative to the right-hand sides bᵢ as they were given, before Q = I − MΦΦᵀ took the known
# eigenvectors out of them. What is left may be rounding alone: along T itself dK and dM are multiples of K and M, so
# that bᵢ is one of Mφᵢ and Qbᵢ = 0. Relative to itself that noise has no solution, since most of it lies in the span of
# MΦ, where it was taken out. It is zero. So it is in reverse mode, whose bᵢ are the cotangents of the solutions:
# where all nodes count alike, for instance, they are multiples of Mφᵢ again.
#
# Small rows need fewer digits, or none: their share in sums over all rows is small. Where the operator
# amplifies more, because λᵢ is near Λ, they count for more.
def wanted_errors(before: OfRows, after: OfRows, amplified: OfRows, tolerance: float, dtype: Any) -> OfRows:
    """Return the errors to reduce rows to, in the energy norm, relative to each row's own; infinite for zero.

    Args:
        before: the `norms` of the right-hand sides bᵢ.
        after: those of their projections Qbᵢ.
        amplified: how much larger the solution of a row becomes than that of another as large.
        tolerance: the accuracy of the largest row.
        dtype: what the eigenvectors and the rows were rounded to.
    """
    xp, largest = amplified.__array_namespace__(), before.max()
    # Where all rows are zero, none is asked for.
    share = after / xp.where(largest > 0, largest, 1) * amplified
    noise = (after <= attainable(0, dtype) * before) | (share <= tolerance)
    return xp.where(noise, xp.inf, xp.minimum(tolerance / xp.where(noise, 1, share), 0.1))


def norms(rows: Rows, lumped: Float[Array, " n_dof"]) -> OfRows:
    """Return ‖rᵢ‖ in the norm of M⁻¹, M replaced by its diagonal."""
    xp = rows.__array_namespace__()
    return xp.sqrt(xp.sum(rows * rows / lumped[None], axis=1))


def group_numbers(
    distance: Float[np.ndarray, " m"], rows: int, tolerance: float, most: int = _MOST_GROUPS
) -> Int[np.ndarray, " m"]:
    """Return the group of each distance from Λ, of a limited number of groups in geometric progression.

    With s groups of distances that differ by up to a ratio ρ the condition is ρ^(1/2s); s weighs factorisations against
    the steps for all rows, which count as often as they are solved for.
    """
    ratio = max(distance.max() / distance.min(), 1 + 1e-12)

    def cost(s: int) -> float:
        root = ratio ** (1 / (4 * s))
        return s * _FACTORISATION + rows * np.log(2 / tolerance) / np.log((root + 1) / (root - 1))

    count = min(min(range(1, _MOST_GROUPS + 1), key=cost), most)
    return np.minimum((np.log(distance.max() / distance) / np.log(ratio) * count).astype(int), count - 1)


def shifts_between(values: Values, nearest: Shifts, farthest: Shifts) -> Shifts:
    """Return for each group of rows the shift of the least condition: its distance from Λ is a geometric mean."""
    xp = values.__array_namespace__()
    targets, below = first_beyond(values) - xp.sqrt(nearest * farthest), -0.1 * values[-1]
    if values.size == 1:
        return xp.broadcast_to(below, targets.shape)
    return middles_of_gaps(values, targets, below)


def middles_of_gaps(values: Values, targets: Shifts, otherwise: Scalar) -> Shifts:
    """Return the middle of the gap of known eigenvalues nearest to each target; ``otherwise`` where all are equal."""
    xp = values.__array_namespace__()
    gaps = xp.diff(values)
    typical = (values[-1] - values[0]) / (values.size - 1)
    distance = xp.abs((values[:-1] + gaps / 2)[None] - targets[:, None])
    chosen = xp.argmin(xp.where(gaps >= 0.1 * typical, distance, xp.inf), axis=1)
    return xp.where(typical > 0, values[chosen] + gaps[chosen] / 2, otherwise)


def unsolved(failed: int | str, total: int) -> str:
    """Say that solves did not converge, and for how many of all rows."""
    return (
        f"derivative: the linear solves for {failed} of {total} eigenpairs did not converge, and their part is NaN. k, "
        "or an end of the interval, may cut a cluster of eigenvalues, or the eigenpairs themselves did not converge: "
        "take another k, interval or solver, or set multiplet='drop' in `eigenpairs`"
    )


def without_known(pencil: SymmetricPencil, vectors: Vectors) -> OfColumns:
    """Return x ↦ x − ΦΦᵀMx, of columns."""
    mass = pencil.mass.of_columns()
    return lambda x: x - matmul(products_with_columns(vectors, mass(x)).T, vectors).T


# All that is as large as the eigenvectors is computed in place: to fill a new array of that size, whose memory the
# system has to provide, takes as long as products with it.
def projected(
    pencil: SymmetricPencil, vectors: Vectors, rhs: Rows, tolerance: float, amplified: OfRows
) -> tuple[Rows, OfRows]:
    """Return Q rhs, Q = I − MΦΦᵀ, and the `wanted_errors` of its rows."""
    lumped = pencil.mass.diagonal()

    def project(b: Rows, _: Array) -> tuple[Rows, OfRows]:
        left = b - pencil.mass.apply(matmul(inner_products(vectors, b), vectors))
        return left, norms(left, lumped)

    before = norms(rhs, lumped)
    left, after = _in_parts(project, rhs, before)
    return left, wanted_errors(before, after, amplified, tolerance, rhs.dtype)


def cleaned(pencil: SymmetricPencil, vectors: Vectors, x: Rows) -> Rows:
    """Return x − ΦΦᵀMx, of rows."""

    def clean(x: Rows) -> tuple[Rows]:
        return (x - matmul(inner_products(vectors, pencil.mass.apply(x)), vectors),)

    return _in_parts(clean, x)[0]


def _in_parts(project: Callable[..., tuple[Array, ...]], *rows: Array) -> tuple[Array, ...]:
    """Return the projections of rows, of some at a time: of a few of them twice, which changes nothing."""
    size = even_size(len(rows[0]), _ROWS)
    starts, _ = row_blocks(len(rows[0]), size)

    def step(number: Array, rows: tuple[Array, ...]) -> tuple[Array, ...]:
        start = jnp.asarray(starts)[number]
        parts = project(*(jax.lax.dynamic_slice_in_dim(each, start, size) for each in rows))
        whole = zip(rows, parts, strict=True)
        return tuple(jax.lax.dynamic_update_slice_in_dim(each, part, start, axis=0) for each, part in whole)

    return jax.lax.fori_loop(0, len(starts), step, rows)


def solve_in_blocks(
    of_group: Callable[[Int[Array, ""]], Any],  # returns what the blocks of a group share
    solve: Callable[..., Columns],  # x for (what the group shares, rhs, wanted, *of_rows) of one block, as columns
    size: int,  # rows of a block
    first: Int[np.ndarray, " groups"],  # the first row of each group of blocks
    rhs: Rows,
    wanted: OfRows,  # the error wanted of each row; where it is infinite there is nothing to solve
    *of_rows: OfRows,
) -> Rows:
    """Solve for blocks of rows, one after another."""
    size = min(size, len(rhs))
    starts, _ = row_blocks(len(rhs), size)
    blocks = jnp.asarray(np.append(first // size, len(starts)))

    def solve_group(group: Array, x: Rows) -> Rows:
        shared = of_group(group)

        def solve_block(number: Array, x: Rows) -> Rows:
            start = jnp.asarray(starts)[number]
            b, error, *own = (jax.lax.dynamic_slice_in_dim(each, start, size) for each in (x, wanted, *of_rows))
            unsolved = start + np.arange(size) >= number * size  # the last block may overlap the one before
            solution = solve(shared, b.T, jnp.where(unsolved, error, jnp.inf), *own).T
            return jax.lax.dynamic_update_slice_in_dim(x, jnp.where(unsolved[:, None], solution, b), start, axis=0)

        return jax.lax.fori_loop(blocks[group], blocks[group + 1], solve_block, x)

    return jax.lax.fori_loop(0, len(first), solve_group, rhs)
