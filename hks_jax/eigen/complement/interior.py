"""Solves with K − λᵢM on the complement of known eigenvectors that lie anywhere in the spectrum, all in JAX.

Eigenvalues are left on both sides of the known ones: K − λᵢM is indefinite on the complement. But let a shift σ, like
λᵢ, lie between Λ₋, the last eigenvalue that is left below, and Λ₊, the first that is left above. Then every λⱼ that is
left lies on the same side of both, and

    A = (K − σM)⁻¹ (K − λᵢM)

has on the complement the eigenvalues (λⱼ − λᵢ)/(λⱼ − σ) > 0. It is symmetric in the inner product xᵀMy. So conjugate
gradients in that inner product solve A xᵢ = (K − σM)⁻¹ bᵢ. As A is computed with the very K − λᵢM, the accuracy of the
factorisation limits how fast they converge, and not the solution.

With the odds ω(λ) = (Λ₊ − λ)/(λ − Λ₋) the condition of A is at most the ratio of ω(λᵢ) and ω(σ): for λᵢ < σ, say, the
eigenvalues of A lie between (λᵢ − Λ₋)/(σ − Λ₋) and (Λ₊ − λᵢ)/(Λ₊ − σ). The odds take the place that the distance from Λ
has in `hks_jax.eigen.complement.common`, their limit for Λ₋ → −∞: rows are grouped by their odds in geometric
progression, and the shift of a group is the geometric mean.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from hks_jax.eigen.complement.adjoint import Adjoint
from hks_jax.eigen.complement.common import SINGULAR, attainable, middles_of_gaps
from hks_jax.eigen.complement.factorised import BLOCK, WINDOW, Factors, Groups, factorise_each, group_blocks, one_of
from hks_jax.eigen.complement.in_blocks import cleaned, projected, solve_in_blocks, without_known
from hks_jax.eigen.origin import LocatedPencil
from hks_jax.linear.conjugate_gradients import conjugate_gradients
from hks_jax.linear.dissection import Dissection, dissect
from hks_jax.linear.multifrontal import Factorisation
from hks_jax.linear.products import products_with_columns, times

Shifted = tuple[Factorisation, Float[Array, " groups"]]
"""Factorisations of K − σM, stacked, and their shifts."""


class InteriorAdjoint(Adjoint[LocatedPencil]):
    """Conjugate gradients in the inner product of M, with a factorisation of K − σM for each group of rows.

    Where `Adjoint` has the lowest eigenvalues, here are the k pairs that the rows belong to, ascending from the
    pencil's origin, and then others next to them, on either side and in any order. Where there is no other they are
    zero vectors, with one of the known eigenvalues.

    Attributes:
        tolerance: to what the error is reduced, in the norm of M, relative to the largest row.
    """

    tolerance: float = eqx.field(default=1e-8, static=True)

    def prepare(self, pencil: LocatedPencil, values: Float[Array, " p"], k: int) -> Shifted:
        """Factorise K − σM for each group of the first k of p eigenvalues."""
        dissection = dissect(pencil.pattern)
        # Compiled without the dissection: what a compiled function hands through is copied.
        factors, shifts = _factorise(dissection, pencil, values, k, self.tolerance)
        return Factorisation(dissection, *factors), shifts

    def solve(
        self,
        prepared: Shifted,
        pencil: LocatedPencil,
        values: Float[Array, " p"],
        vectors: Float[Array, "p n_dof"],
        rhs: Float[Array, "k n_dof"],
    ) -> Float[Array, "k n_dof"]:
        """Solve (K − λᵢM) xᵢ = Q rhsᵢ with ΦᵀMxᵢ = 0; see `Adjoint.solve`."""
        return _solve(*prepared, pencil, values, vectors, rhs, self.tolerance)


@partial(jax.jit, static_argnames=("k", "tolerance"))
def _factorise(
    dissection: Dissection, pencil: LocatedPencil, values: Float[Array, " p"], k: int, tolerance: float
) -> tuple[Factors, Float[Array, " groups"]]:
    groups, (low, high) = _group(dissection, values, k, tolerance), _left(pencil, values)
    odds = (high - values[:k]) / (values[:k] - low)
    mean = jnp.sqrt(odds[groups.first] * odds[groups.last])
    # Where all that is known is one eigenvalue there is the gap between it and the origin, above which it is the first.
    shifts = middles_of_gaps(jnp.sort(values), (high + mean * low) / (1 + mean), values[0] / 2)
    return factorise_each(dissection, pencil, shifts), shifts


@partial(jax.jit, static_argnames="tolerance")
def _solve(
    factors: Factorisation,
    shifts: Float[Array, " groups"],
    pencil: LocatedPencil,
    values: Float[Array, " p"],
    vectors: Float[Array, "p n_dof"],
    rhs: Float[Array, "k n_dof"],
    tolerance: float,
) -> Float[Array, "k n_dof"]:
    k = rhs.shape[0]
    stiffness, mass = pencil.stiffness.of_columns(), pencil.mass.of_columns()
    low, high = _left(pencil, values)
    amplified = (high - low) / 2 / jnp.minimum(high - values[:k], values[:k] - low)
    clean = without_known(pencil, vectors)

    def inner(x: Float[Array, "n b"], y: Float[Array, "n b"]) -> Float[Array, " b"]:
        return jnp.sum(x * mass(y), axis=0)

    def of_group(group: Int[Array, ""]) -> tuple[Factorisation, Array, Array]:
        near = vectors[jnp.argsort(jnp.abs(values - shifts[group]))[:WINDOW]]
        return one_of(factors, group), near.T, pencil.mass.apply(near)

    def solve_block(group: tuple[Factorisation, Array, Array], b: Array, wanted: Array, eigenvalues: Array) -> Array:
        factor, near, near_images = group

        def product(x: Float[Array, "n b"]) -> tuple[Float[Array, "n b"], Float[Array, " b"]]:
            return factor.solve_columns(stiffness(x) - eigenvalues * mass(x)), SINGULAR * inner(x, x)

        # Of what rounding leaves of the known eigenvectors, A amplifies those next to σ alone.
        def without_near(x: Float[Array, "n b"]) -> Float[Array, "n b"]:
            return x - times(near, products_with_columns(near_images, x))

        right = factor.solve_columns(b)
        return conjugate_gradients(product, without_near, right, wanted, inner, clean).converged

    left, wanted = projected(pencil, vectors, rhs, attainable(tolerance, rhs.dtype), amplified)
    first = _group(factors.dissection, values, k, tolerance).first
    return cleaned(pencil, vectors, solve_in_blocks(of_group, solve_block, BLOCK, first, left, wanted, values[:k]))


def _left(pencil: LocatedPencil, values: Float[Array, " p"]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return estimates of Λ₋ and Λ₊, the eigenvalues next to the known ones that are left."""
    return jnp.min(values) - pencil.spacing, jnp.max(values) + pencil.spacing


def _group(dissection: Dissection, values: Float[Array, " p"], k: int, tolerance: float) -> Groups:
    """Group blocks of rows whose odds are of one order, if eigenvalues are spread evenly and others on both sides."""
    others = (values.size - k) / 2
    return group_blocks(dissection, lambda row: (k + others - row) / (row + others + 1), values.dtype, k, tolerance)
