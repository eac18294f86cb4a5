"""Linear solves with K − λᵢM on the complement of computed eigenvectors, all in JAX.

The method is described in `hks_jax.eigen.adjoints.adjoint`: conjugate gradients with a factorisation of K − σM as
preconditioner for each group of neighbouring eigenvalues. Eigenvalues are grouped by index instead of value, so that
array shapes are static. By Weyl's law, eigenvalues are distributed so regularly that groups by index suffice. All
products with the Jacobian at one point share the factorisations of K − σM.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from hks_jax.compilation import is_concrete_on_cpu, jit_quickly
from hks_jax.eigen.adjoints import adjoint as complement
from hks_jax.eigen.adjoints.adjoint import Adjoint, Columns, OfRows, Rows, Scalar, Shifts, Values, Vectors
from hks_jax.eigen.inertia import LocatedPencil
from hks_jax.linear.conjugate_gradients import conjugate_gradients
from hks_jax.linear.dissection import Dissection, dissect
from hks_jax.linear.multifrontal import Factorisation, factorise
from hks_jax.linear.operators import OfColumns
from hks_jax.linear.pencil import SymmetricPencil
from hks_jax.linear.products import matmul, products_with_columns

BLOCK = 16
"""The number of right-hand sides that conjugate gradients treat at once."""
WINDOW = 32
"""The number of eigenvectors nearest to a shift that every conjugate gradient step projects out."""
_GROWTH = 4e7
"""The largest factor by which solves amplify rounding errors along other computed eigenvectors; 1e4 to 1e5 is usual."""
_MEMORY = 5e8
"""The maximal total size of the factorisations in bytes."""

Shifted = tuple[Factorisation, Shifts]
"""Stacked factorisations of K − σM, and their shifts."""
Groups = tuple[Int[np.ndarray, " groups"], Int[np.ndarray, " groups"]]
"""The first row of each group, and its last row; static."""


class FactorisedAdjoint(Adjoint[SymmetricPencil]):
    """Conjugate gradients, preconditioned with a factorisation of K − σM for each group of neighbouring eigenvalues.

    The solver supports every pencil that can be factorised: grids (mainly in 2D), meshes, and sparse matrices.

    Attributes:
        tolerance: the wanted error in the energy norm, relative to the largest right-hand side.
        solves: the expected number of calls of `solve` per call of `prepare`. If many calls of `solve` are expected,
            the solver factorises K − σM at more shifts σ, so that each call takes fewer steps.

    Examples:
        >>> solver = hj.ShiftInvert(adjoint=hj.FactorisedAdjoint(tolerance=1e-6))
        >>> domain = lambda s: hj.TensorField(field.grid, s * field.tensors)
        >>> scaled = lambda s: hj.hks(hj.eigenpairs(domain(s), 12, solver=solver), [0.5 * s], "volume")[0, 4, 4]
        >>> print(abs(jax.grad(scaled)(1.0)) < 1e-3)  # lengths and times grow alike
        True
    """

    tolerance: float = eqx.field(default=1e-8, static=True)
    solves: int = eqx.field(default=1, static=True)

    def prepare(self, pencil: SymmetricPencil, values: Values, k: int) -> Shifted:
        """Factorise K − σM for each group of the first k of p eigenvalues."""
        dissection = dissect(pencil.pattern)
        if is_concrete_on_cpu((pencil, values)):
            # Factorise at one shift after another by the function that the eigensolver has already compiled.
            dissection = jax.device_put(dissection)
            shifts = self._shifts(pencil, np.asarray(values), self.groups(dissection, len(values), k, values.dtype))
            each = [factorise(dissection, pencil.shifted(jnp.asarray(shift))) for shift in shifts]
            stacked = jax.tree.map(lambda *x: np.stack(x), *(factor.arrays for factor in each))
            return Factorisation(dissection, *jax.device_put(stacked)), jax.device_put(shifts)
        factors, shifts = self._factorise(dissection, pencil, values, k)
        return Factorisation(dissection, *factors), shifts

    @jit_quickly(static_argnames="k")
    def _factorise(
        self, dissection: Dissection, pencil: SymmetricPencil, values: Values, k: int
    ) -> tuple[tuple[Any, ...], Shifts]:
        shifts = self._shifts(pencil, values, self.groups(dissection, len(values), k, values.dtype))
        factors = jax.lax.map(lambda shift: factorise(dissection, pencil.shifted(shift)), shifts)
        return factors.arrays, shifts

    @jit_quickly()
    def solve(self, prepared: Shifted, pencil: SymmetricPencil, values: Values, vectors: Vectors, rhs: Rows) -> Rows:
        """Solve (K − λᵢM) xᵢ = Q rhsᵢ with ΦᵀMxᵢ = 0; see `Adjoint.solve`."""
        factors, shifts = prepared
        k, tolerance = len(rhs), complement.attainable(self.tolerance, rhs.dtype)
        clean = complement.without_known(pencil, vectors)
        window = WINDOW if _GROWTH * jnp.finfo(rhs.dtype).eps <= tolerance else len(values)

        def solver_of(group: Int[Array, ""]) -> Callable[..., Columns]:
            arrays = jax.tree.map(lambda stacked: stacked[group], factors.arrays)
            near = vectors[jnp.argsort(jnp.abs(values - shifts[group]))[:window]]
            columns, images = near.T, pencil.mass.apply(near)

            def without_near(x: Columns) -> Columns:
                return x - matmul(columns, products_with_columns(images, x))

            factor = Factorisation(factors.dissection, *arrays)
            return partial(self._solve_block, pencil, values, without_near, clean, factor)

        left, wanted = complement.projected(pencil, vectors, rhs, tolerance, self._amplified(pencil, values, k))
        first, _ = self.groups(factors.dissection, len(values), k, values.dtype)
        x = complement.solve_in_blocks(solver_of, BLOCK, first, left, wanted, values[:k])
        return complement.cleaned(pencil, vectors, x) if isinstance(self, InteriorAdjoint) else x

    def groups(self, dissection: Dissection, p: int, k: int, dtype: np.dtype) -> Groups:
        """Return the first and the last row of each group of right-hand sides, which `group_numbers` determines."""
        start = np.arange(0, k, BLOCK)
        end = np.minimum(start + BLOCK, k)
        distance = self._distance(p, k, (start + end - 1) / 2)
        entries = sum(own.size * (own.shape[1] + 2 * boundary.shape[1]) for own, boundary, *_ in dissection.levels)
        room = max(int(_MEMORY / (entries * dtype.itemsize)), 1)
        number = complement.group_numbers(distance, k * self.solves, complement.attainable(self.tolerance, dtype), room)
        _, first = np.unique(number, return_index=True)
        return start[first], np.append(start[first[1:]], k) - 1

    # `InteriorAdjoint` overrides the following methods.

    def _distance(self, p: int, k: int, row: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
        """Return, by Weyl's law in 2D, numbers proportional to the distances of the rows' λᵢ from eigenvalue p + 1."""
        return p + 1 - row

    def _shifts(self, pencil: Any, values: Values, groups: Groups) -> Shifts:
        (first, last), beyond = groups, complement.first_beyond(values)
        return complement.shifts_between(values, beyond - values[last], beyond - values[first])

    def _amplified(self, pencil: Any, values: Values, k: int) -> OfRows:
        return complement.amplification(values, k)

    # If rounding leaves a component of the residual along a computed eigenvector φⱼ, each step multiplies this
    # component by (λⱼ − λᵢ)/(λⱼ − σ), which is large mainly for λⱼ near σ. So each step projects out only the
    # eigenvectors φⱼ with λⱼ nearest to σ, unless the others would spoil the last digits that the tolerance asks for.
    # Restarts project out all computed eigenvectors.
    def _solve_block(
        self, pencil: Any, values: Values, without_near: OfColumns, without_known: OfColumns, *of_block: Any
    ) -> Columns:
        factor, b, wanted, shifts = of_block
        stiffness, mass = pencil.stiffness.of_columns(), pencil.mass.of_columns()

        def precondition(r: Columns) -> Columns:
            return without_near(factor.solve(r))

        product = complement.definite_product(stiffness, mass, shifts, complement.first_beyond(values))
        return conjugate_gradients(product, precondition, b, wanted, clean=without_known).converged


# The eigenvalues on the complement of the computed eigenvectors lie on both sides of the computed eigenvalues, so that
# K − λᵢM is indefinite. Let Λ₋ be the last eigenvalue on the complement below the computed ones, and Λ₊ the first
# above. Let the shift σ, like λᵢ, lie between Λ₋ and Λ₊. Then each λⱼ on the complement is above both σ and λᵢ, or
# below both. So
#
#     A = (K − σM)⁻¹ (K − λᵢM)
#
# has the eigenvalues (λⱼ − λᵢ)/(λⱼ − σ) > 0 on the complement. The matrix A is symmetric in the inner product xᵀMy, in
# which conjugate gradients solve A xᵢ = (K − σM)⁻¹ bᵢ for the right-hand side bᵢ. Products with A use the exact
# K − λᵢM. So an inaccurate factorisation of K − σM slows down convergence, but does not change the solution.
#
# Define the odds ω(λ) = (Λ₊ − λ)/(λ − Λ₋) of an eigenvalue λ. The condition number of the preconditioned matrix A is at
# most the ratio of the odds ω(λᵢ) and ω(σ); for example, if λᵢ < σ, the eigenvalues of A lie between (λᵢ − Λ₋)/(σ − Λ₋)
# and (Λ₊ − λᵢ)/(Λ₊ − σ). `group_numbers` divides the odds ω(λᵢ), instead of the distances Λ₊ − λᵢ, into groups; the
# odds ω(σ) of a group's shift are the geometric mean of its extreme odds. In the limit Λ₋ → −∞, the odds ω(λᵢ) are
# proportional to the distances Λ₊ − λᵢ.
class InteriorAdjoint(FactorisedAdjoint):
    """Conjugate gradients in the inner product of M, with a factorisation of K − σM for each group of rows.

    Of the p computed eigenpairs, the first k belong to the k right-hand sides, and ascend from the origin of a
    `LocatedPencil`. Guard pairs on either side of the k pairs follow in any order. Zero vectors, with one of the
    computed eigenvalues, replace guard pairs that do not exist. The error is measured in the norm of M.
    """

    def _distance(self, p: int, k: int, row: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
        """Return the odds ω(λᵢ) of the rows' λᵢ, as if eigenvalues were equidistant, with (p − k)/2 guards per side."""
        others = (p - k) / 2
        return (k + others - row) / (row + others + 1)

    def _shifts(self, pencil: Any, values: Values, groups: Groups) -> Shifts:
        (first, last), (low, high) = groups, _left(pencil, values)
        odds = (high - values) / (values - low)
        mean = jnp.sqrt(odds[first] * odds[last])
        # If all computed eigenvalues are equal, the shift is halfway between the origin and their common value.
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

        # Rounding leaves components along computed eigenvectors φⱼ. A amplifies such a component only if λⱼ is near σ.
        right = factor.solve(b)
        return conjugate_gradients(product, without_near, right, wanted, inner, without_known).converged


def _left(pencil: LocatedPencil, values: Values) -> tuple[Scalar, Scalar]:
    """Estimate Λ₋ and Λ₊, the eigenvalues on the complement nearest to the computed eigenvalues."""
    return jnp.min(values) - pencil.spacing, jnp.max(values) + pencil.spacing
