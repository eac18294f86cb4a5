"""Products of stencils with blocks of columns: nodal arrays (*shape, b), the column innermost.

In this layout each coefficient is read once for all columns: in 3D it is about twice as fast as row after row.
"""

import math
from collections.abc import Callable, Iterator
from itertools import product
from operator import mul

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hks_jax.linear import accelerators


def stencil(
    coefficients: Float[Array, "offsets *shape"], periodic: tuple[bool, ...]
) -> Callable[[Float[Array, "*shape b"]], Float[Array, "*shape b"]]:
    """Return x ↦ y[i] = Σₒ coefficients[o, i] x[i + o], offsets in the order of ``product((-1, 0, 1), repeat=d)``.

    A single coefficient per node is a diagonal. Those across a side that is not periodic must be 0. What is done to the
    coefficients is done here: for products in a loop, call this outside.
    """
    if coefficients.shape[0] == 1:
        return lambda x: coefficients[0][..., None] * x
    if any(periodic):
        together = side_by_side(coefficients)
        return lambda x: product_with_rim(together, with_rim(x, periodic))
    # Node after node in one row, a neighbour is a fixed distance away. Across the sides, where the row goes on
    # elsewhere, there is nothing: elements end there, and their entries were never written.
    shape = coefficients.shape[1:]
    nodes = math.prod(shape)
    strides = [math.prod(shape[axis + 1 :]) for axis in range(len(shape))]
    distances = [sum(map(mul, offset, strides)) for offset in product((-1, 0, 1), repeat=len(shape))]
    reach = distances[-1]
    row = side_by_side(coefficients).reshape(nodes, -1)
    # On accelerators an array for each offset, behind a barrier: XLA would take them apart anew for each product.
    apart = (
        jax.lax.optimization_barrier(tuple(jnp.split(row, len(distances), axis=1))) if accelerators.at_hand() else ()
    )

    def apply(x: Float[Array, "*shape b"]) -> Float[Array, "*shape b"]:
        b = x.shape[-1]
        padded = jnp.pad(x.reshape(nodes, b), ((reach, reach), (0, 0)))
        y = jnp.zeros((), x.dtype)
        for o, distance in enumerate(distances):
            own = apart[o] if apart else row[:, o, None]
            y = y + own * jax.lax.slice(padded, (reach + distance, 0), (reach + distance + nodes, b))
        return y.reshape(x.shape)

    return apply


def stencil_product(
    coefficients: Float[Array, "offsets *shape"], x: Float[Array, "*shape b"], periodic: tuple[bool, ...]
) -> Float[Array, "*shape b"]:
    """Return one product; see `stencil`."""
    return stencil(coefficients, periodic)(x)


def side_by_side(coefficients: Float[Array, "offsets *shape"]) -> Float[Array, " entries"]:
    """Return the coefficients, a node's side by side in memory: read in 3^d places, a product takes twice as long.

    Flat, as XLA would otherwise choose an order of the axes itself.
    """
    return jnp.moveaxis(coefficients, 0, -1).reshape(-1)


def with_rim(x: Float[Array, "*shape"], periodic: tuple[bool, ...], first: int = 0) -> Float[Array, "*rimmed"]:
    """Return x with a node more at either end of some axes, from the ``first`` on: the opposite one's, or zero."""
    for axis, wraps in enumerate(periodic, start=first):
        widths = [(1, 1) if a == axis else (0, 0) for a in range(x.ndim)]
        x = jnp.pad(x, widths, mode="wrap" if wraps else "constant")
    return x


def product_with_rim(together: Float[Array, " entries"], x: Float[Array, "*rimmed b"]) -> Float[Array, "*shape b"]:
    """Return the product with columns whose neighbours beyond all sides are there; coefficients `side_by_side`."""
    coefficients = together.reshape(*(n - 2 for n in x.shape[:-1]), -1)
    y = jnp.zeros((), x.dtype)
    for o, shifted in enumerate(neighbours(x, x.ndim - 1)):
        y = y + coefficients[..., o, None] * shifted
    return y


def stencil_outer(
    p: Float[Array, "*shape b"], x: Float[Array, "*shape b"], periodic: tuple[bool, ...]
) -> Float[Array, "offsets *shape"]:
    """Return Σ_b p[i, b] x[i + o, b] for every offset: the derivative of Σ_b pᵀCx by the coefficients of C."""
    rimmed = with_rim(x, periodic)
    return jnp.stack([jnp.sum(p * shifted, axis=-1) for shifted in neighbours(rimmed, len(periodic))])


def neighbours(x: Float[Array, "*rimmed"], dimension: int) -> Iterator[Float[Array, "*shape"]]:
    """Go through x shifted by each offset along its first axes, so many, which are given with their rim."""
    after = (0,) * (x.ndim - dimension)
    shape = [n - 2 if axis < dimension else n for axis, n in enumerate(x.shape)]
    for start in product((0, 1, 2), repeat=dimension):
        start = (*start, *after)
        yield jax.lax.slice(x, start, [s + n for s, n in zip(start, shape, strict=True)])


def to_columns(rows: Float[Array, "b nodes"], shape: tuple[int, ...]) -> Float[Array, "*shape b"]:
    """Return rows of flat nodal arrays as a block of columns."""
    # The barriers, here and below, keep XLA from fusing the transposition with the products before or after it, which
    # would then go through memory in the wrong order.
    return jax.lax.optimization_barrier(jnp.moveaxis(rows.reshape(-1, *shape), 0, -1))


def to_rows(columns: Float[Array, "*shape b"]) -> Float[Array, "b nodes"]:
    """Return a block of columns as rows of flat nodal arrays."""
    return jnp.moveaxis(jax.lax.optimization_barrier(columns), -1, 0).reshape(columns.shape[-1], -1)
