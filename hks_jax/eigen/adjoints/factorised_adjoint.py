"""Linear solves with K − λᵢM on the complement of computed eigenvectors, all in JAX.

The method is described in `hks_jax.eigen.adjoints.complement`: conjugate gradients with a factorisation of K − σM as
preconditioner for each group of neighbouring eigenvalues. Eigenvalues are grouped by index instead of value, so that
array shapes are static. By Weyl's law, eigenvalues are distributed so regularly that groups by index suffice. All
products with the Jacobian at one point share the factorisations of K − σM.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from hks_jax.compilation import is_concrete_on_cpu, jit_quickly
from hks_jax.eigen.adjoints import complement
from hks_jax.eigen.adjoints.complement import Adjoint, Columns, Rows, Shifts, Values, Vectors
from hks_jax.linear.dissection import Dissection, dissect
from hks_jax.linear.multifrontal import Factorisation, factorise
from hks_jax.linear.operators import OfColumns
from hks_jax.linear.products import matmul, products_with_columns
from hks_jax.linear.symmetric_pencil import SymmetricPencil

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
            shifts = self._shifts(dissection, np.asarray(values), k)
            each = [factorise(dissection, pencil.shifted(jnp.asarray(shift))) for shift in shifts]
            stacked = jax.tree.map(lambda *x: np.stack(x), *(factor.arrays for factor in each))
            return Factorisation(dissection, *jax.device_put(stacked)), jax.device_put(shifts)
        factors, shifts = self._factorise(dissection, pencil, values, k)
        return Factorisation(dissection, *factors), shifts

    @jit_quickly(static_argnames="k")
    def _factorise(
        self, dissection: Dissection, pencil: SymmetricPencil, values: Values, k: int
    ) -> tuple[tuple[Any, ...], Shifts]:
        shifts = self._shifts(dissection, values, k)
        factors = jax.lax.map(lambda shift: factorise(dissection, pencil.shifted(shift)), shifts)
        return factors.arrays, shifts

    @jit_quickly()
    def solve(self, prepared: Shifted, pencil: SymmetricPencil, values: Values, vectors: Vectors, rhs: Rows) -> Rows:
        """Solve (K − λᵢM) xᵢ = Q rhsᵢ with ΦᵀMxᵢ = 0; see `Adjoint.solve`."""
        factors, shifts = prepared
        k, tolerance = len(rhs), complement.attainable(self.tolerance, rhs.dtype)
        window = WINDOW if _GROWTH * jnp.finfo(rhs.dtype).eps <= tolerance else len(values)

        # If rounding leaves a component of the residual along a computed eigenvector φⱼ, each step multiplies this
        # component by (λⱼ − λᵢ)/(λⱼ − σ), which is large mainly for λⱼ near σ. So each step projects out only the
        # eigenvectors φⱼ with λⱼ nearest to σ, unless the others would spoil the last digits that the tolerance asks
        # for. Restarts project out all computed eigenvectors.
        def preconditioner(group: Int[Array, ""]) -> Callable[[], OfColumns]:
            factor = Factorisation(factors.dissection, *jax.tree.map(lambda stacked: stacked[group], factors.arrays))
            near = vectors[jnp.argsort(jnp.abs(values - shifts[group]))[:window]]
            columns, images = near.T, pencil.mass.apply(near)

            def precondition(r: Columns) -> Columns:
                z = factor.solve(r)
                return z - matmul(columns, products_with_columns(images, z))

            return lambda: precondition

        (first, _), clean = self._groups(factors.dissection, len(values), k, values.dtype), complement.without_known
        problem = pencil, values, vectors, rhs, tolerance
        return complement.solve_by_blocks(*problem, BLOCK, first, preconditioner, clean=clean(pencil, vectors))

    def _shifts(self, dissection: Dissection, values: Values, k: int) -> Shifts:
        """Return the shift of each group of the first k eigenvalues."""
        (first, last), beyond = self._groups(dissection, len(values), k, values.dtype), complement.first_beyond(values)
        return complement.shifts_between(values, beyond - values[last], beyond - values[first])

    def _groups(self, dissection: Dissection, p: int, k: int, dtype: np.dtype) -> Groups:
        """Return the first and the last row of each group of right-hand sides, which `group_numbers` determines."""
        start = np.arange(0, k, BLOCK)
        end = np.minimum(start + BLOCK, k)
        distance = p + 1 - (start + end - 1) / 2  # of each block's λᵢ from eigenvalue p + 1, by Weyl's law in 2D
        entries = sum(own.size * (own.shape[1] + 2 * boundary.shape[1]) for own, boundary, *_ in dissection.levels)
        room = max(int(_MEMORY / (entries * dtype.itemsize)), 1)
        number = complement.group_numbers(distance, k * self.solves, complement.attainable(self.tolerance, dtype), room)
        _, first = np.unique(number, return_index=True)
        return start[first], np.append(start[first[1:]], k) - 1
