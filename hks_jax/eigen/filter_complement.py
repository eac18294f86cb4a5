"""Solves with K − λᵢM on the complement of known eigenvectors, matrix-free: conjugate gradients with a polynomial.

The filter of `hks_jax.eigen.chebyshev`, with its sign changed, is the preconditioner; the known eigenvectors are taken
out after each step, by products of matrices for a block of right-hand sides at once.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hks_jax.eigen.chebyshev import Band, correction, degree_for, upper_end
from hks_jax.eigen.coarsening import finest_level
from hks_jax.eigen.conjugate_gradients import conjugate_gradients, first_beyond
from hks_jax.eigen.products import combine, inner_products
from hks_jax.fem.columns import to_columns, to_rows
from hks_jax.fem.pencil import Pencil
from hks_jax.fem.space import GridSpace

_GAIN = 20.0
"""What the preconditioner's polynomial is at λ: more costs more products with K, less more projections."""


def prepare(pencil: Pencil) -> Float[Array, ""]:
    """Return the upper end of the spectrum of D⁻¹K."""
    assert isinstance(pencil.space, GridSpace)
    return upper_end(finest_level(pencil), pencil.space.periodic)


def solve(
    high: Float[Array, ""],
    pencil: Pencil,
    values: Float[Array, " p"],
    vectors: Float[Array, "p n_dof"],
    rhs: Float[Array, "k n_dof"],
    tolerance: float,
    block: int,
) -> Float[Array, "k n_dof"]:
    """Solve (K − λᵢM) xᵢ = (I − MΦΦᵀ) rhsᵢ with ΦᵀMxᵢ = 0; NaN where it does not converge.

    The tolerance is for the error in the energy norm, relative.
    """
    space, dtype = pencil.space, rhs.dtype
    assert isinstance(space, GridSpace)
    level, periodic = finest_level(pencil), space.periodic
    k, tolerance = rhs.shape[0], max(tolerance, 10 * float(jnp.finfo(dtype).eps))
    beyond = first_beyond(values)
    band = Band(jnp.minimum(beyond, high / 2), high)
    images = jax.lax.map(pencil.mass.apply, vectors, batch_size=block)

    def without_known(x: Float[Array, "b n_dof"]) -> Float[Array, "b n_dof"]:
        return x - combine(inner_products(images, x), vectors)

    def one_block(args: tuple[Float[Array, " b"], Float[Array, "b n_dof"]]) -> Float[Array, "b n_dof"]:
        shifts, b = args
        degree = jnp.ceil(jnp.clip(degree_for(band, jnp.max(shifts), _GAIN), 2, 60)).astype(int)

        def precondition(r: Float[Array, "b n_dof"]) -> Float[Array, "b n_dof"]:
            columns = to_columns(space.extend(r, outside=0.0).reshape(r.shape[0], -1), level.shape)
            z = correction(level, periodic, band, columns, shifts, degree)
            return without_known(-space.restrict(to_rows(z).reshape(-1, *level.shape)))

        wanted = jnp.where(jnp.any(b != 0, axis=1), tolerance, jnp.inf)
        return conjugate_gradients(pencil, precondition, shifts, b, wanted, beyond)

    rhs = rhs - combine(inner_products(vectors, rhs), images)
    count = -(-k // block)
    padded = jnp.pad(rhs, ((0, count * block - k), (0, 0)))
    shifts = jnp.pad(values[:k], (0, count * block - k))
    found = jax.lax.map(one_block, (shifts.reshape(count, block), padded.reshape(count, block, -1)))
    return found.reshape(count * block, -1)[:k]
