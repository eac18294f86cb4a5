"""Solves with K − λᵢM on the complement of known eigenvectors, all in JAX.

The method is that of `hks_jax.eigen.complement.adjoint`: conjugate gradients, preconditioned with a factorisation of
K − σM for each group of neighbouring eigenvalues. Groups are made by index and not by value, so that shapes are static:
by Weyl's law eigenvalues are spread evenly enough for that. The factorisations depend on the matrices alone, and serve
all products with a Jacobian at one point.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from hks_jax.compilation import jit_quickly, known_here
from hks_jax.eigen.complement import adjoint as complement
from hks_jax.eigen.complement.adjoint import Adjoint, Columns, OfRows, Rows, Scalar, Shifts, Values, Vectors
from hks_jax.eigen.inertia import LocatedPencil
from hks_jax.linear.conjugate_gradients import conjugate_gradients
from hks_jax.linear.dissection import Dissection, dissect
from hks_jax.linear.multifrontal import Factorisation, factorise
from hks_jax.linear.operators import OfColumns
from hks_jax.linear.pencil import SymmetricPencil
from hks_jax.linear.products import matmul, products_with_columns

BLOCK = 16
"""Rows solved at once."""
WINDOW = 32
"""Eigenvectors next to a shift that every step takes out."""
_GROWTH = 4e7
"""By what rounding in the direction of known eigenvectors grows at most: 1e4 to 1e5 as a rule, measured."""
_MEMORY = 5e8
"""Bytes that factorisations may take together."""

Shifted = tuple[Factorisation, Shifts]
"""Factorisations of K − σM, stacked, and their shifts."""
Groups = tuple[Int[np.ndarray, " groups"], Int[np.ndarray, " groups"]]
"""The first row of each group, and its last row; static."""


class FactorisedAdjoint(Adjoint[SymmetricPencil]):
    """Conjugate gradients, preconditioned with a factorisation of K − σM for each group of neighbouring eigenvalues.

    For any pencil that can be factorised: grids, above all in 2D, meshes, sparse matrices.

    Attributes:
        tolerance: of the error in the energy norm, relative to the largest row.
        solves: how often one preparation serves, about. Many solves are worth more factorisations.
    """

    tolerance: float = eqx.field(default=1e-8, static=True)
    solves: int = eqx.field(default=1, static=True)

    def prepare(self, pencil: SymmetricPencil, values: Values, k: int) -> Shifted:
        """Factorise K − σM for each group of the first k of p eigenvalues."""
        dissection = dissect(pencil.pattern)
        if known_here((pencil, values)):
            # One after another: the solver has compiled that.
            dissection = jax.device_put(dissection)
            shifts = self._shifts(pencil, np.asarray(values), self.groups(dissection, len(values), k, values.dtype))
            each = [factorise(dissection, pencil.shifted(jnp.asarray(shift))) for shift in shifts]
            stacked = jax.tree.map(lambda *x: np.stack(x), *((f.downward, f.upward, f.pivots) for f in each))
            return Factorisation(dissection, *jax.device_put(stacked)), jax.device_put(shifts)
        # Compiled without the dissection: what a compiled function hands through is copied.
        factors, shifts = self._factorise(dissection, pencil, values, k)
        return Factorisation(dissection, *factors), shifts

    @jit_quickly(static_argnames="k")
    def _factorise(
        self, dissection: Dissection, pencil: SymmetricPencil, values: Values, k: int
    ) -> tuple[tuple[Any, ...], Shifts]:
        shifts = self._shifts(pencil, values, self.groups(dissection, len(values), k, values.dtype))
        factors = jax.lax.map(lambda shift: factorise(dissection, pencil.shifted(shift)), shifts)
        return (factors.downward, factors.upward, factors.pivots), shifts

    @jit_quickly()
    def solve(self, prepared: Shifted, pencil: SymmetricPencil, values: Values, vectors: Vectors, rhs: Rows) -> Rows:
        """Solve (K − λᵢM) xᵢ = Q rhsᵢ with ΦᵀMxᵢ = 0; see `Adjoint.solve`."""
        factors, shifts = prepared
        k, tolerance = len(rhs), complement.attainable(self.tolerance, rhs.dtype)
        clean = complement.without_known(pencil, vectors)

        def of_group(group: Int[Array, ""]) -> tuple[Factorisation, Array, Array]:
            fields = jax.tree.map(lambda stacked: stacked[group], (factors.downward, factors.upward, factors.pivots))
            near = vectors[jnp.argsort(jnp.abs(values - shifts[group]))[:WINDOW]]
            return Factorisation(factors.dissection, *fields), near.T, pencil.mass.apply(near)

        def solve_block(group: tuple[Factorisation, Array, Array], b: Array, wanted: Array, shifts: Array) -> Columns:
            factor, near, images = group

            def without_near(x: Columns) -> Columns:
                return x - matmul(near, products_with_columns(images, x))

            return self._solve_block(pencil, values, without_near, clean, factor, b, wanted, shifts)

        left, wanted = complement.projected(pencil, vectors, rhs, tolerance, self._amplified(pencil, values, k))
        first, _ = self.groups(factors.dissection, len(values), k, values.dtype)
        x = complement.solve_in_blocks(of_group, solve_block, BLOCK, first, left, wanted, values[:k])
        clean_enough = not isinstance(self, InteriorAdjoint) and _GROWTH * jnp.finfo(rhs.dtype).eps <= tolerance
        return x if clean_enough else complement.cleaned(pencil, vectors, x)

    def groups(self, dissection: Dissection, p: int, k: int, dtype: np.dtype) -> Groups:
        """Group blocks of the first k of p rows, each by the distance that its middle row has; see `group_numbers`."""
        start = np.arange(0, k, BLOCK)
        end = np.minimum(start + BLOCK, k)
        distance = self._distance(p, k, (start + end - 1) / 2)
        entries = sum(own.size * (own.shape[1] + 2 * boundary.shape[1]) for own, boundary, *_ in dissection.levels)
        room = max(int(_MEMORY / (entries * dtype.itemsize)), 1)
        number = complement.group_numbers(distance, k * self.solves, complement.attainable(self.tolerance, dtype), room)
        _, first = np.unique(number, return_index=True)
        return start[first], np.append(start[first[1:]], k) - 1

    # What differs where eigenvalues are left on both sides of those that are known follows.

    def _distance(self, p: int, k: int, row: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
        """Return how far the eigenvalues of rows are from Λ, by Weyl's law in 2D."""
        return p + 1 - row

    def _shifts(self, pencil: Any, values: Values, groups: Groups) -> Shifts:
        (first, last), beyond = groups, complement.first_beyond(values)
        return complement.shifts_between(values, beyond - values[last], beyond - values[first])

    def _amplified(self, pencil: Any, values: Values, k: int) -> OfRows:
        """Return how much larger the solutions of rows become than those of others as large."""
        return complement.amplification(values, k)

    # Where r has some φⱼ by rounding, (K − λᵢM)(K − σM)⁻¹ multiplies it by (λⱼ − λᵢ)/(λⱼ − σ): by much for those next
    # to σ above all, which is why no others are taken out before the end, or before that makes it start again.
    def _solve_block(
        self, pencil: Any, values: Values, without_near: OfColumns, without_known: OfColumns, *of_block: Any
    ) -> Columns:
        factor, b, wanted, shifts = of_block
        stiffness, mass = pencil.stiffness.of_columns(), pencil.mass.of_columns()

        def precondition(r: Columns) -> Columns:
            return without_near(factor.solve(r))

        product = complement.definite_product(stiffness, mass, shifts, complement.first_beyond(values))
        return conjugate_gradients(product, precondition, b, wanted, clean=without_known).converged


# Eigenvalues are left on both sides of the known ones: K − λᵢM is indefinite on the complement. But let a shift σ, like
# λᵢ, lie between Λ₋, the last eigenvalue that is left below, and Λ₊, the first that is left above. Then every λⱼ that
# is left lies on the same side of both, and
#
#     A = (K − σM)⁻¹ (K − λᵢM)
#
# has on the complement the eigenvalues (λⱼ − λᵢ)/(λⱼ − σ) > 0. It is symmetric in the inner product xᵀMy. So conjugate
# gradients in that inner product solve A xᵢ = (K − σM)⁻¹ bᵢ. As A is computed with the very K − λᵢM, the accuracy of
# the factorisation limits how fast they converge, and not the solution.
#
# With the odds ω(λ) = (Λ₊ − λ)/(λ − Λ₋) the condition of A is at most the ratio of ω(λᵢ) and ω(σ): for λᵢ < σ, say, the
# eigenvalues of A lie between (λᵢ − Λ₋)/(σ − Λ₋) and (Λ₊ − λᵢ)/(Λ₊ − σ). The odds take the place of the distance from
# Λ, their limit for Λ₋ → −∞: rows are grouped by their odds in geometric progression, and the shift of a group is the
# geometric mean.
class InteriorAdjoint(FactorisedAdjoint):
    """Conjugate gradients in the inner product of M, with a factorisation of K − σM for each group of rows.

    Where `Adjoint` has the lowest eigenvalues, here are the k pairs that the rows belong to, ascending from the origin
    of a `LocatedPencil`, and then others next to them, on either side and in any order. Where there is no other they
    are zero vectors, with one of the known eigenvalues. The error is measured in the norm of M.
    """

    def _distance(self, p: int, k: int, row: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
        """Return the odds, if eigenvalues are spread evenly, and as many others known on both sides."""
        others = (p - k) / 2
        return (k + others - row) / (row + others + 1)

    def _shifts(self, pencil: Any, values: Values, groups: Groups) -> Shifts:
        (first, last), (low, high) = groups, _left(pencil, values)
        odds = (high - values) / (values - low)
        mean = jnp.sqrt(odds[first] * odds[last])
        # Where all known are one eigenvalue, there is the gap between it and the origin, above which it is the first.
        return complement.middles_of_gaps(jnp.sort(values), (high + mean * low) / (1 + mean), values[0] / 2)

    def _amplified(self, pencil: Any, values: Values, k: int) -> OfRows:
        low, high = _left(pencil, values)
        return (high - low) / 2 / jnp.minimum(high - values[:k], values[:k] - low)

    def _solve_block(
        self, pencil: Any, values: Values, without_near: OfColumns, without_known: OfColumns, *of_block: Any
    ) -> Columns:
        factor, b, wanted, shifts = of_block
        stiffness, mass = pencil.stiffness.of_columns(), pencil.mass.of_columns()

        def inner(x: Columns, y: Columns) -> Float[Array, " b"]:
            return jnp.sum(x * mass(y), axis=0)

        def product(x: Columns) -> tuple[Columns, Float[Array, " b"]]:
            return factor.solve(stiffness(x) - shifts * mass(x)), complement.SINGULAR * inner(x, x)

        # Of the traces of known eigenvectors that rounding leaves, A amplifies those next to σ alone.
        right = factor.solve(b)
        return conjugate_gradients(product, without_near, right, wanted, inner, without_known).converged


def _left(pencil: LocatedPencil, values: Values) -> tuple[Scalar, Scalar]:
    """Return estimates of Λ₋ and Λ₊, the eigenvalues next to the known ones that are left."""
    return jnp.min(values) - pencil.spacing, jnp.max(values) + pencil.spacing
