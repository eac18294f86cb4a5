"""The accuracy of eigenpairs: their residuals, and the effect of rounding on eigenvalues."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from hks_jax.compilation import library_of, numpy_where_known
from hks_jax.linear.products import of_each_column, products_with_columns, row_blocks
from hks_jax.linear.symmetric_pencil import SymmetricPencil, change_by_rounding

_EXCUSED = 0.01
"""The largest relative residual that is accepted as rounding."""
_ALIKE = 0.1
"""The inner product above which two normalised vectors count as the same eigenvector."""
_ROWS = 8
"""The number of vectors measured together, so that their images fit into the cache."""


def measure_pairs(
    pencil: SymmetricPencil, vectors: Float[Array, "m n_dof"], values: Float[Array, " m"] | None = None
) -> tuple[Float[Array, " m"], Float[Array, " m"], Bool[Array, " m"]]:
    """Return, for each vector φ, the eigenvalue λ, the residual ‖Kφ − λMφ‖ / ‖Mφ‖, and whether φ was found twice.

    A vector counts as found twice if it is nearly parallel to one of the few vectors before it. If eigenvalues are not
    given, they are the Rayleigh quotients φᵀKφ / φᵀMφ, and vectors are not compared. In double precision, vectors are
    never compared, because all solvers keep vectors orthogonal.
    """
    stiffness, mass = pencil.stiffness.of_columns(), pencil.mass.of_columns()
    m, size, width = len(vectors), min(_ROWS, len(vectors)), min(2 * _ROWS, len(vectors))
    starts, place = row_blocks(m, size)

    def measure(start: Array) -> tuple[Array, Array, Array]:
        columns = jax.lax.optimization_barrier(jax.lax.dynamic_slice_in_dim(vectors, start, size).T)
        force, image = stiffness(columns), mass(columns)
        if values is None:
            quotients = of_each_column(columns, force) / of_each_column(columns, image)
        else:
            quotients = jax.lax.dynamic_slice_in_dim(values, start, size)
        twice = jnp.zeros(size, bool)
        if values is not None and vectors.dtype == jnp.float32:
            first = jnp.maximum(start + size - width, 0)
            products = products_with_columns(jax.lax.dynamic_slice_in_dim(vectors, first, width), image)
            before = first + jnp.arange(width)[:, None] < start + jnp.arange(size)[None]
            twice = jnp.any(before & (jnp.abs(products) > _ALIKE), axis=0)
        residual = force - quotients[None] * image
        return quotients, jnp.sqrt(of_each_column(residual, residual) / of_each_column(image, image)), twice

    return jax.tree.map(lambda of_blocks: of_blocks[place], jax.lax.map(measure, jnp.asarray(starts)))


@jax.jit
def rounding_of_quotients(
    pencil: SymmetricPencil, vectors: Float[Array, "m n_dof"], chosen: Int[Array, " c"]
) -> Float[Array, " c"]:
    """Bound the changes of the Rayleigh quotients of the chosen vectors by rounding of K; see `change_by_rounding`."""
    sizes, mass = pencil.stiffness.with_flat(jnp.abs(pencil.stiffness.flat())).of_columns(), pencil.mass.of_columns()
    weights = 2 * sizes(jnp.ones((vectors.shape[1], 1), vectors.dtype))[:, 0]
    starts, place = row_blocks(len(chosen), min(_ROWS, len(chosen)))

    def bounds(start: Array) -> Float[Array, " b"]:
        numbers = jax.lax.dynamic_slice_in_dim(chosen, start, min(_ROWS, len(chosen)))
        columns = jax.lax.optimization_barrier(vectors[numbers].T)
        changes = change_by_rounding(sizes(columns), weights, columns)
        return jnp.finfo(vectors.dtype).eps * changes / of_each_column(columns, mass(columns))

    return jax.lax.map(bounds, jnp.asarray(starts))[place]


def measured_on_host(
    pencil: Any, vectors: Float[np.ndarray, "m n_dof"], values: Float[np.ndarray, " m"]
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"], Bool[np.ndarray, " m"]]:
    """Return the result of `measure_pairs` for SciPy matrices; each vector is compared with all vectors before it."""
    columns = np.ascontiguousarray(vectors.T)
    image = pencil.mass.tocsr() @ columns
    force = pencil.stiffness.tocsr() @ columns
    residuals = np.linalg.norm(force - image * values, axis=0) / np.linalg.norm(image, axis=0)
    twice = np.zeros(len(values), bool)
    if vectors.dtype == np.float32:
        twice = np.any(np.abs(np.tril(vectors @ image, -1)) > _ALIKE, axis=1)
    return values, residuals, twice


def allowed_residuals(scale: Any, rounding: Any, tolerance: float, stored: bool = False) -> Any:
    """Return the largest residuals ‖Kφ − λMφ‖ / ‖Mφ‖ at which pairs count as converged.

    The tolerance is relative to ``scale``, the larger of |λ| and a typical eigenvalue. Residuals up to the level of
    rounding are accepted too, but only up to one per cent of ``scale``, because a less accurate pair is useless. If
    the pairs were only ``stored`` in low precision, the residuals are those of the stored vectors, and have no limit.
    """
    xp = library_of(scale)
    return xp.maximum(tolerance * scale, rounding if stored else xp.minimum(rounding, _EXCUSED * scale))


def indistinct(pencil: SymmetricPencil, dtype: np.dtype) -> Float[Array, ""]:
    """Return 4 ε times the `largest` eigenvalue: the distance at which two eigenvalues are equal within rounding."""
    return 4 * jnp.finfo(dtype).eps * largest(pencil)


def largest(pencil: SymmetricPencil) -> Float[Array, ""]:
    """Estimate the largest eigenvalue by 4·max|Kᵢᵢ/Mᵢᵢ|, which is exact on a uniform grid in 2D and 3D.

    The estimate is at least the mean over i of Σⱼ|Kᵢⱼ|, divided by max Mᵢᵢ, in case the diagonal of K is small.
    """
    return _largest(pencil.stiffness, pencil.mass)


def largest_of(stiffness: Any, mass: Any) -> Any:
    """Return the result of `largest` for matrices of JAX or SciPy."""
    masses = mass.diagonal()
    xp = library_of(masses)
    entries = stiffness.data if xp is np else stiffness.flat()
    mean = xp.sum(xp.abs(entries)) / masses.size / xp.max(masses)
    return xp.maximum(4 * xp.max(xp.abs(stiffness.diagonal()) / masses), mean)


_largest = numpy_where_known()(largest_of)
