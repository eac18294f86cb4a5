"""Derivatives of eigenvectors: that of their frame, and rotations of computed eigenvectors among themselves."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from hks_jax.compilation import library_of, numpy_where_known
from hks_jax.eigen.adjoints.complement import OfRows, Rows, Scalar, Values
from hks_jax.eigen.quality import indistinct
from hks_jax.fem.pencil import Pencil
from hks_jax.linear.linear_map import first_order_only, with_transpose
from hks_jax.linear.linear_program import linear_program
from hks_jax.linear.products import even_size, inner_products, matmul, row_blocks

_ROWS = 128
"""The number of eigenvectors whose products with all others are computed at once, which limits the memory."""


# With fᵢ = (dK − λᵢ dM) φᵢ, the derivative of an eigenvector has the component
#
#     φⱼᵀM dφᵢ = (φⱼᵀfᵢ)/(λᵢ − λⱼ) for j ≠ i,    φᵢᵀM dφᵢ = −½ φᵢᵀ dM φᵢ
#
# along φⱼ. If λᵢ = λⱼ and j ≠ i, this component is arbitrary (a gauge), because every basis of the eigenspace is valid.
# The derivative rule sets gauge components to −½ φⱼᵀ dM φᵢ, which keeps Φ M-orthonormal and is never NaN. A component
# also counts as a gauge if |λᵢ − λⱼ| is below √ε (λ − λ₀), where λ is the larger of the two eigenvalues and λ₀ the
# lowest of all, because a division by so small a gap would lose all digits. So dφᵢ is a derivative only if λᵢ is
# simple: `of_simple` replaces the other derivatives by NaN. Spectral functions do not depend on the basis, so their
# derivatives must not contain gauge components, and use the frame instead (hks_jax/signatures/spectral_functions.py).
@jax.custom_jvp
def with_rotations(frame: Rows, values: Values, pencil: Pencil) -> Rows:
    """Return the frame, with a derivative that includes rotations of the eigenvectors among themselves."""
    return frame


@with_rotations.defjvp
def _with_rotations_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    frame, values, pencil = first_order_only(primals)
    constants = frame, values, indistinct(pencil, values.dtype)
    return frame, tangents[0] + linear_program(_rotations, (), constants, tangents[2], frame)


@jax.checkpoint
def _rotations(frame: Rows, values: Values, rounding: Scalar, change: Pencil) -> Rows:
    stiffness, mass = changes_between(frame, change)
    apart, inverse = gaps(values, len(values), rounding)
    return matmul(jnp.where(apart, inverse * (stiffness - values[:, None] * mass), -mass / 2), frame)


def gaps(values: Any, k: int, rounding: Any) -> tuple[Any, Any]:
    """Return the mask (k, p) of pairs of distinct eigenvalues, and 1/(λᵢ − λⱼ), which is 0 for equal eigenvalues."""
    xp = library_of(values)
    gap, above = values[:k, None] - values[None], values - xp.nanmin(values)
    least = xp.sqrt(xp.finfo(values.dtype).eps) * xp.maximum(above[:k, None], above[None])
    # The bound of rounding errors is a worst case, which may exceed even the range of all eigenvalues. This limit holds
    # then too, unlike in `multiplets.gaps_to_next`, because derivatives would lack the terms of distinct eigenvalues.
    rounding = xp.minimum(rounding, xp.nanmax(above[: k + 1]) / 1000)
    apart = xp.abs(gap) > xp.maximum(least, rounding)
    return apart, xp.where(apart, 1 / xp.where(apart, gap, 1), 0)


def changes_between(vectors: Rows, change: Pencil) -> tuple[Float[Array, "k k"], Float[Array, "k k"]]:
    """Return φᵢᵀ dK φⱼ and φᵢᵀ dM φⱼ."""
    size = even_size(len(vectors), _ROWS)
    starts, place = row_blocks(len(vectors), size)

    @jax.checkpoint  # reverse mode would otherwise store a copy of the vectors
    def products(start: Array) -> list[Float[Array, "size k"]]:
        own = jax.lax.dynamic_slice_in_dim(vectors, start, size)
        return [products_with_constants(matrix.apply(own), vectors) for matrix in (change.stiffness, change.mass)]

    stiffness, mass = (blocks[place] for blocks in jax.lax.map(products, jnp.asarray(starts)))
    return stiffness, mass


# JAX's automatic transpose of the inner products would multiply by the transposed vectors, which takes twice as long.
def products_with_constants(images: Float[Array, "b n_dof"], vectors: Rows) -> Float[Array, "b k"]:
    """Return the inner products of rows of ``images`` and ``vectors``; derivatives treat ``vectors`` as constant."""
    return with_transpose(partial(inner_products, vectors), lambda mix: matmul(mix, vectors), images)


@jax.custom_jvp
def of_simple(vectors: Rows, values: OfRows, following: Scalar, kept: Bool[Array, " k"], pencil: Pencil) -> Rows:
    """Return the vectors. A nonzero derivative of a vector becomes NaN unless its eigenvalue is simple and kept."""
    return vectors


# For equal eigenvalues λᵢ = λⱼ = λ, the derivative of Σᵢ f(λᵢ) φᵢ(x)² contains f'(λ) φᵢ φⱼ φᵢᵀ(dK − λ dM)φⱼ. The
# derivatives dλᵢ give only the terms with i = j. Rotations of the eigenvectors of λ give no terms, because they do not
# change the sum of their φᵢ(x)². So no finite derivative of eigenvectors gives the terms with i ≠ j.
@of_simple.defjvp
def _of_simple_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    vectors, values, following, kept, pencil = primals
    multiple = _is_multiple(values, following, kept, indistinct(pencil, values.dtype), pencil.n_fixed > 0)

    def undefined(x: Rows) -> Rows:
        return jnp.where((multiple & jnp.any(x != 0, axis=1))[:, None], jnp.nan, x)

    return vectors, with_transpose(undefined, undefined, tangents[0])


@numpy_where_known(static_argnums=4)
def _is_multiple(values: Any, following: Any, kept: Any, rounding: Any, fixed: bool) -> Any:
    """Return the mask (k) of pairs that are not kept or whose eigenvalue is multiple, except fixed null vectors."""
    xp = library_of(values)
    size = xp.maximum(xp.abs(values), values - values[:1])
    least = xp.maximum(xp.finfo(values.dtype).eps ** 0.5 * size, rounding)
    near = xp.abs(values[:, None] - values[None]) <= least[:, None]
    mixed = (xp.sum(near, axis=1) > 1) & ~((values == 0) & fixed)  # perturbations do not change fixed null vectors
    return mixed | (following - values <= least) | ~kept
