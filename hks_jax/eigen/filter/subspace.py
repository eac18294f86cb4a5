"""A subspace of nodal functions, stored as rows on one device or several, and blockwise Rayleigh–Ritz in it.

A filter needs a few functions on the whole grid, and Rayleigh–Ritz needs all functions on a part of the grid. Between
rounds, each device stores all functions on its slab, (m, nodes of the slab). For the filters, device i of p gets the
blocks i, i + p, i + 2p, … of rows, which balances the load, because low modes converge first.

``slabs`` is None on a single device, where no communication is needed.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import PartitionSpec
from jaxtyping import Array, Float, Int

from hks_jax.fem.halo import Slabs
from hks_jax.fem.nodal import NodalPencil, to_columns
from hks_jax.linear import lapack
from hks_jax.linear.accelerators import row_by_row
from hks_jax.linear.dense_eigh import pencil_eigh
from hks_jax.linear.loops import by_column_ranges
from hks_jax.linear.products import aligned, matmul

EVERYWHERE = PartitionSpec()
_CHUNK = 1 << 14
"""The number of nodes at which Ritz vectors are computed at once."""

Values = Float[Array, " m"]
Rows = Float[Array, "m nodes"]


def shared(slabs: Slabs | None, function: Callable, in_specs: Any, out_specs: Any) -> Callable:
    """Return the function that every device applies to its own parts of the arrays; see `jax.shard_map`."""
    if slabs is None:
        return function
    # `check_vma` cannot verify loops of different lengths, nor that results agree on all devices.
    return jax.shard_map(function, mesh=slabs.mesh, in_specs=in_specs, out_specs=out_specs, check_vma=False)


def own_blocks(slabs: Slabs | None, count: int) -> Int[Array, " own"]:
    """Return the indices of the blocks of rows, out of ``count``, that this device filters."""
    if slabs is None:
        return jnp.arange(count)
    return jax.lax.axis_index(slabs.name) + slabs.mesh.size * jnp.arange(count // slabs.mesh.size)


def to_own_rows(slabs: Slabs | None, block: int, x: Float[Array, "m slab"]) -> Float[Array, "own nodes"]:
    """Return the blocks of rows that this device filters, on the whole grid, given all rows on this device's slab."""
    if slabs is None:
        return x
    m, width = x.shape
    dealt = x.reshape(-1, slabs.mesh.size, block, width)
    whole = jax.lax.all_to_all(dealt, slabs.name, 1, 3, tiled=True)
    return whole.reshape(m // slabs.mesh.size, -1)[:, : math.prod(slabs.shape)]


def to_slabs(slabs: Slabs | None, block: int, rows: Float[Array, "own nodes"]) -> Float[Array, "m slab"]:
    """Return all rows on this device's slab, given the blocks of rows that this device has filtered."""
    if slabs is None:
        return rows
    missing = math.prod(slabs.padded_shape) - rows.shape[1]
    whole = jnp.pad(rows, ((0, 0), (0, missing))).reshape(-1, 1, block, rows.shape[1] + missing)
    dealt = jax.lax.all_to_all(whole, slabs.name, 3, 1, tiled=True)
    return dealt.reshape(rows.shape[0] * slabs.mesh.size, -1)


def block_of(x: Rows, number: Array, block: int, shape: tuple[int, ...]) -> Float[Array, "*shape b"]:
    """Return a block of the rows as columns."""
    return to_columns(row_by_row(jax.lax.dynamic_slice_in_dim(x, number * block, block)), shape)


def rayleigh_ritz(pencil: NodalPencil, slabs: Slabs | None, block: int, x: Rows) -> tuple[Values, Rows]:
    """Return ascending Ritz values and M-orthonormal Ritz vectors as rows; each device gets its slab of the vectors."""
    m, nodes = x.shape
    products = pencil.products()

    def among_rows(number: Array) -> tuple[Array, ...]:
        images = products(block_of(x, number, block, pencil.shape))
        # The images Kx and Mx stay columns; as rows, XLA would compute them in row-major layout, seven times as slowly.
        return tuple(matmul(x, image.reshape(nodes, block)) for image in images)

    both = jax.lax.map(among_rows, jnp.arange(m // block))
    both = both if slabs is None else slabs.total(both)
    stiffness, mass = (jnp.moveaxis(p, 0, 1).reshape(m, m) for p in both)
    values, vectors = pencil_eigh((stiffness + stiffness.T) / 2, _positive((mass + mass.T) / 2))
    values, mix = (_of_first(slabs, found) for found in (values, vectors.T))
    return values, by_column_ranges(partial(matmul, mix), _CHUNK, x)


# A filter leaves vectors almost dependent if fewer modes than vectors lie below its band, as on coarse grids. Rounding
# then makes the Gram matrix indefinite. The shift is larger than the errors of its entries, and only directions that
# rounding dominates change by it (shifted Cholesky QR, Fukaya et al. 2020); later rounds make them accurate.
def _positive(gram: Float[Array, "m m"]) -> Float[Array, "m m"]:
    """Return a Gram matrix, with a larger diagonal if it is not positive definite after rounding."""
    failed = ~jnp.all(jnp.isfinite(lapack.cholesky(gram)))
    shift = 10 * len(gram) * jnp.finfo(gram.dtype).eps * jnp.diagonal(gram)
    return gram + jnp.diag(jnp.where(failed, shift, 0))


def measured(pencil: NodalPencil, slabs: Slabs | None, block: int, values: Values, x: Rows) -> tuple[Values, Values]:
    """Return ‖Kx − θMx‖/‖Mx‖ and xᵀKx / xᵀDx of each row x with value θ, where D is the lumped mass."""
    products = pencil.products()

    def of_block(number: Array) -> tuple[Array, ...]:
        columns = block_of(x, number, block, pencil.shape)
        theta = jax.lax.dynamic_slice_in_dim(values, number * block, block)
        image, moved = products(columns)
        apart = image - aligned(theta, moved) * moved
        terms = apart**2, moved**2, columns * image, pencil.lumped[..., None] * columns**2
        return tuple(jnp.sum(term, tuple(range(columns.ndim - 1))) for term in terms)

    sums = jax.lax.map(of_block, jnp.arange(values.size // block))
    sums = sums if slabs is None else slabs.total(sums)
    residual, moved, energy, lumped = (s.ravel() for s in sums)
    return jnp.sqrt(residual / moved), energy / lumped


def _of_first(slabs: Slabs | None, x: Array) -> Array:
    """Broadcast the value of the first device, because rounding may differ between devices."""
    return x if slabs is None else slabs.total(jnp.where(jax.lax.axis_index(slabs.name) == 0, x, 0))
