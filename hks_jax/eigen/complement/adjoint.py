"""What derivatives of eigenpairs solve with: the interface, and what its methods have in common, in NumPy or in JAX.

The derivatives of a truncated spectrum need them. On the M-orthogonal complement of the p lowest eigenvectors K − λᵢM
is positive definite, and so is K − σM for *every* σ below the next eigenvalue Λ, whatever its sign elsewhere.
Preconditioned with it, the spectrum of conjugate gradients lies between 1 and (Λ − λᵢ)/(Λ − σ). So the rows are grouped
by their λᵢ, each group has its own shift σ among them, and a few factorisations bring every row to convergence in a few
steps. `eigen.host` does so with SciPy's factorisations, `factorised` with those in JAX; the filter's adjoint has a
polynomial instead.
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar, Generic, TypeVar

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from hks_jax.checks import require_number
from hks_jax.linear.pencil import SymmetricPencil

Array = Any
"""NumPy's or JAX's, the same for all arguments and the result."""

SINGULAR = 1e-8
"""The gap, relative to the last eigenvalue, below which K − λᵢM counts as singular on the complement."""

_LEAST = 100
"""The size of a row that vanishes but for rounding, in units of ε times its former size; and the finest tolerance."""
_FACTORISATION = 200
"""What one factorisation costs, in solves of one row: about 100, doubled as small rows take few steps."""
_MOST_GROUPS = 16

P = TypeVar("P", bound=SymmetricPencil)
"""What it solves with: any pencil, or those of a domain, or of a grid."""


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
        """Check the tolerance."""
        require_number("tolerance", self.tolerance, 1)

    def prepare(self, pencil: P, values: Float[Array, " p"], k: int) -> Any:
        """Return what `solve` for the first k of p eigenvalues needs and no right-hand side changes."""
        return None

    @abstractmethod
    def solve(
        self,
        prepared: Any,
        pencil: P,
        values: Float[Array, " p"],
        vectors: Float[Array, "p n_dof"],
        rhs: Float[Array, "k n_dof"],
    ) -> Float[Array, "k n_dof"]:
        """Solve (K − λᵢM) xᵢ = Q rhsᵢ with ΦᵀMxᵢ = 0, where Q = I − MΦΦᵀ, p ≥ k and p < n_dof.

        Args:
            prepared: from `prepare`.
            pencil: K and M.
            values: (p,) the lowest eigenvalues, ascending.
            vectors: (p, n_dof) their M-orthonormal eigenvectors Φ.
            rhs: (k, n_dof); row i belongs to λᵢ.

        Returns:
            (k, n_dof). What did not converge is NaN. Traceable.
        """


def attainable(tolerance: float, dtype: Any) -> float:
    """Return the tolerance, or what rounded eigenvectors allow if that is more: beyond it is noise."""
    return max(tolerance, _LEAST * float(np.finfo(dtype).eps))


def definite_product(
    pencil: SymmetricPencil, shifts: Float[Array, " b"], beyond: Float[Array, ""]
) -> Callable[[Float[Array, "n b"]], tuple[Float[Array, "n b"], Float[Array, " b"]]]:
    """Return x ↦ (K − λᵢM) xᵢ, with the energy below which an eigenvalue equal to λᵢ is left on the complement."""
    stiffness, mass = pencil.stiffness.of_columns(), pencil.mass.of_columns()

    def product(x: Float[Array, "n b"]) -> tuple[Float[Array, "n b"], Float[Array, " b"]]:
        image = mass(x)
        energy = (x * image).sum(axis=0)
        return stiffness(x) - shifts[None] * image, SINGULAR * beyond * energy

    return product


def first_beyond(values: Float[Array, " p"]) -> Float[Array, ""]:
    """Return an estimate Λ of the first eigenvalue that is left; the last of the known ones is positive."""
    return values[-1] * (1 + 1 / values.size)


def amplification(values: Float[Array, " p"], k: int) -> Float[Array, " k"]:
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
def wanted_errors(
    before: Float[Array, " b"],
    after: Float[Array, " b"],
    largest: Float[Array, ""],
    amplified: Float[Array, " b"],
    tolerance: float,
    dtype: Any,
) -> Float[Array, " b"]:
    """Return the errors to reduce rows to, in the energy norm, relative to each row's own; infinite for zero.

    Args:
        before: the `norms` of the right-hand sides bᵢ.
        after: those of their projections Qbᵢ.
        largest: the largest of all right-hand sides, other blocks included.
        amplified: how much larger the solution of a row becomes than that of another as large.
        tolerance: the accuracy of the largest row.
        dtype: what the eigenvectors and the rows were rounded to.
    """
    xp = amplified.__array_namespace__()
    # Where all rows are zero, none is asked for.
    share = after / xp.where(largest > 0, largest, 1) * amplified
    noise = (after <= attainable(0, dtype) * before) | (share <= tolerance)
    return xp.where(noise, xp.inf, xp.minimum(tolerance / xp.where(noise, 1, share), 0.1))


def norms(rows: Float[Array, "b n"], lumped: Float[Array, " n"]) -> Float[Array, " b"]:
    """Return ‖rᵢ‖ in the norm of M⁻¹, M replaced by its diagonal."""
    xp = rows.__array_namespace__()
    return xp.sqrt(xp.sum(rows * rows / lumped[None], axis=1))


def group_numbers(
    distance: Float[np.ndarray, " m"], rows: int, tolerance: float, most: int = _MOST_GROUPS
) -> Int[np.ndarray, " m"]:
    """Return the group of each distance from Λ, of a limited number of groups in geometric progression.

    Rows count as often as they are solved for.

    With s groups of distances that differ by up to a ratio ρ the condition is ρ^(1/2s); s weighs factorisations against
    the steps for all rows.
    """
    ratio = max(distance.max() / distance.min(), 1 + 1e-12)

    def cost(s: int) -> float:
        root = ratio ** (1 / (4 * s))
        return s * _FACTORISATION + rows * np.log(2 / tolerance) / np.log((root + 1) / (root - 1))

    count = min(min(range(1, _MOST_GROUPS + 1), key=cost), most)
    return np.minimum((np.log(distance.max() / distance) / np.log(ratio) * count).astype(int), count - 1)


def shifts_between(
    values: Float[Array, " p"], nearest: Float[Array, " g"], farthest: Float[Array, " g"]
) -> Float[Array, " g"]:
    """Return a shift for each group of rows whose distances from Λ lie between the given ones.

    The geometric mean of the two leaves the least condition, √ of their ratio.
    """
    xp = values.__array_namespace__()
    targets, below = first_beyond(values) - xp.sqrt(nearest * farthest), -0.1 * values[-1]
    if values.size == 1:
        return xp.broadcast_to(below, targets.shape)
    return middles_of_gaps(values, targets, below)


def middles_of_gaps(
    values: Float[Array, " p"], targets: Float[Array, " g"], otherwise: Float[Array, ""]
) -> Float[Array, " g"]:
    """Return the middle of the gap between two known eigenvalues that is nearest to each target: it is no eigenvalue.

    Where all p ≥ 2 are equal it is ``otherwise``.
    """
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
