"""Stencils on blocks of nodal columns, (*shape, b), the columns innermost."""

from collections.abc import Iterator
from itertools import product

import jax.numpy as jnp
from jaxtyping import Array, Float


def stencil_product(
    coefficients: Float[Array, "offsets *shape"], x: Float[Array, "*shape b"], periodic: tuple[bool, ...]
) -> Float[Array, "*shape b"]:
    """Multiply columns by a stencil: y[i] = Σ_o c[o, i] x[i + o].

    Args:
        coefficients: 3^d a node, offsets in the order of ``itertools.product((-1, 0, 1), repeat=d)``.
        x: columns; nothing lies beyond the sides of axes that are not periodic.
        periodic: per axis.
    """
    y = jnp.zeros((), x.dtype)
    for c, neighbours in zip(coefficients, _neighbours(x, periodic), strict=True):
        y = y + c[..., None] * neighbours
    return y


def stencil_outer(
    p: Float[Array, "*shape b"], x: Float[Array, "*shape b"], periodic: tuple[bool, ...]
) -> Float[Array, "offsets *shape"]:
    """Return Σ_b p[i, b] x[i + o, b] for every offset: the derivative of Σ_b pᵀCx by the coefficients of C."""
    return jnp.stack([jnp.sum(p * neighbours, axis=-1) for neighbours in _neighbours(x, periodic)])


def _neighbours(x: Array, periodic: tuple[bool, ...]) -> Iterator[Array]:
    shape = x.shape[:-1]
    for axis, wraps in enumerate(periodic):
        widths = [(1, 1) if a == axis else (0, 0) for a in range(x.ndim)]
        x = jnp.pad(x, widths, mode="wrap" if wraps else "constant")
    for start in product((0, 1, 2), repeat=len(shape)):
        yield x[tuple(slice(s, s + n) for s, n in zip(start, shape, strict=True))]
