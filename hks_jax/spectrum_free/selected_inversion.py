"""The diagonal of exp(−tM⁻¹K)M⁻¹ on 2D grids by rational approximation and selected inversion.

exp(−x) ≈ Re Σ w/(x − z), so the diagonal is that of Re Σ w (tK − zM)⁻¹. Line by line of the grid tK − zM is block
tridiagonal, and the diagonal of its inverse follows from its factorisation (Takahashi, Fagan and Chin 1973): with the
Schur complements Sᵢ going down the lines, Gᵢ = Sᵢ⁻¹ + Sᵢ⁻¹ Cᵢ Gᵢ₊₁ Cᵢᵀ Sᵢ⁻¹ coming back.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from hks_jax.fem.space import GridSpace
from hks_jax.spectrum_free.poles import exponential_poles

Bands = Complex[Array, "levels lines lines 3 n"]


class _Levels(NamedTuple):
    """Which grid lines make up each block: static.

    Attributes:
        axis: the axis along which the lines are counted.
        lines: (levels, p) the lines of each level; −1 stands for one that does not exist. Where the axis is periodic
            it is folded: lines i and n − i make one level, which couples to the next alone.
    """

    axis: int
    lines: np.ndarray


def levels(space: GridSpace) -> _Levels:
    """Choose the axis to go along: one that is not periodic, and the longer one."""
    axis = min((0, 1), key=lambda a: (space.periodic[a], -space.node_shape[a]))
    n = space.node_shape[axis]
    if not space.periodic[axis]:
        return _Levels(axis, np.arange(n)[:, None])
    low = np.arange(n // 2 + 1)
    high = (n - low) % n
    return _Levels(axis, np.stack([low, np.where(high == low, -1, high)], axis=1))


def inversion_flops(space: GridSpace) -> float:
    """Estimate the floating-point operations of one pole."""
    at = levels(space)
    return 40.0 * at.lines.shape[0] * (at.lines.shape[1] * space.node_shape[1 - at.axis]) ** 3


@partial(jax.jit, static_argnames=("space", "pairs"))
def selected_inversion(
    stiffness: Float[Array, "9 *shape"],
    mass: Float[Array, "..."],
    times: Float[Array, " m"],
    space: GridSpace,
    pairs: int,
) -> Float[Array, "m *shape"]:
    """Return the diagonal at each time, (m, *shape); meaningless at nodes that are not free.

    Args:
        stiffness: K, zero at nodes that are not free.
        mass: M likewise, a stencil (9, *shape) or a diagonal (*shape).
        times: t.
        space: the space.
        pairs: how many pairs of poles.
    """
    if mass.ndim == space.dimension:
        mass = jnp.zeros_like(stiffness).at[4].set(mass)
    poles, weights = exponential_poles(pairs)
    complex_type = jnp.result_type(stiffness.dtype, jnp.complex64)
    # Nodes that are not free are identity rows.
    fixed = jnp.zeros(stiffness.shape, complex_type).at[4].set(jnp.asarray(~space.free, complex_type))

    # One pole at a time, also in the transpose: what it needs is computed again.
    @jax.checkpoint
    def term(inputs: tuple[Array, Array, Array]) -> Array:
        time, pole, weight = inputs
        return jnp.real(weight * _diagonal_of_inverse(time * stiffness - pole * mass + fixed, space))

    def at(time: Array) -> Array:
        some = jnp.broadcast_to(time, poles.shape), jnp.asarray(poles, complex_type), jnp.asarray(weights, complex_type)
        return jnp.sum(jax.lax.map(term, some), axis=0)

    return jax.lax.map(at, times)


def _diagonal_of_inverse(coefficients: Complex[Array, "9 *shape"], space: GridSpace) -> Complex[Array, "*shape"]:
    at = levels(space)
    shape = space.node_shape
    table = coefficients.reshape(3, 3, *shape)
    if at.axis == 1:
        table = table.transpose(1, 0, 3, 2)
    inside = _bands(table, at.lines, at.lines)
    down = _bands(table, at.lines[:-1], at.lines[1:])
    up = _bands(table, at.lines[1:], at.lines[:-1])
    levels_count, lines = at.lines.shape
    size = lines * table.shape[-1]
    missing = jnp.repeat(jnp.asarray(at.lines < 0), table.shape[-1], axis=1)

    def dense(bands: Array, absent: Array) -> Array:
        return _apply(bands, jnp.eye(size, dtype=bands.dtype)) + jnp.diag(absent.astype(bands.dtype))

    def eliminate(inverse: Array, level: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        bands, absent, coupling = level
        following = _inverse(dense(bands, absent) - _both_sides(coupling, inverse))
        return following, following

    first = _inverse(dense(inside[0], missing[0]))
    _, inverses = jax.lax.scan(eliminate, first, (inside[1:], missing[1:], up))
    inverses = jnp.concatenate([first[None], inverses])

    def substitute(block: Array, level: tuple[Array, Array]) -> tuple[Array, Array]:
        inverse, coupling = level
        block = inverse + _matmul(_matmul(inverse, _both_sides(coupling, block)), inverse)
        return block, jnp.diagonal(block)

    last = inverses[-1]
    _, diagonals = jax.lax.scan(substitute, last, (inverses[:-1], down), reverse=True)
    diagonals = jnp.concatenate([diagonals, jnp.diagonal(last)[None]])
    exists = at.lines >= 0
    order = np.argsort(at.lines[exists])
    result = diagonals.reshape(levels_count, lines, -1)[exists][order]
    return result.T if at.axis == 1 else result


def _bands(table: Complex[Array, "3 3 lines n"], rows: np.ndarray, cols: np.ndarray) -> Bands:
    """Return the couplings of lines ``rows`` (l, p) with lines ``cols`` (l, q) as bands (l, p, q, 3, n)."""
    n = table.shape[2]
    row, col = rows[:, :, None], cols[:, None, :]
    offset = (col - row + 1) % n  # 0, 1, 2: the line before, the same, the next
    there = (row >= 0) & (col >= 0) & (offset < 3)
    found = table[np.where(there, offset, 0), :, np.maximum(row, 0)]
    return jnp.where(there[..., None, None], found, 0)


def _apply(bands: Complex[Array, "p q 3 n"], x: Complex[Array, "qn m"]) -> Complex[Array, "pn m"]:
    """Multiply by couplings between lines. Beyond the sides they are zero, so that rolling serves every axis."""
    p, q, _, n = bands.shape
    lines = x.reshape(q, n, -1)
    rolled = [jnp.roll(lines, 1 - o, axis=1) for o in range(3)]
    rows = [sum(bands[i, j, o][:, None] * rolled[o][j] for j in range(q) for o in range(3)) for i in range(p)]
    return jnp.concatenate(rows)


def _both_sides(bands: Array, x: Array) -> Array:
    """Return BxBᵀ for a symmetric x."""
    return _apply(bands, _apply(bands, x).T)


@jax.custom_jvp
def _inverse(matrix: Complex[Array, "n n"]) -> Complex[Array, "n n"]:
    return jnp.linalg.inv(matrix)


@_inverse.defjvp
def _inverse_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    # Nothing but the inverse is kept for the transpose.
    inverse = _inverse(*primals)
    return inverse, -_matmul(_matmul(inverse, *tangents), inverse)


def _matmul(a: Array, b: Array) -> Array:
    return jnp.matmul(a, b, precision="highest")
