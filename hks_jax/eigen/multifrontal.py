"""The multifrontal LDLᵀ factorisation of K − σM on a grid: solves, and by its inertia a count of eigenvalues.

All of it is batched dense algebra, one batch for each level of the nested dissection: O(N^1.5) operations to factorise
in 2D, O(N log N) to solve, O(log N) steps one after another; the same code on every device, under `jit` and `vmap`.
"""

import math
from itertools import accumulate

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from hks_jax.compilation import jit_quickly
from hks_jax.eigen.dissection import Dissection
from hks_jax.eigen.symmetric_inverse import symmetric_inverses
from hks_jax.fem.operators import StencilOperator
from hks_jax.fem.pencil import Pencil


class Factorisation(eqx.Module):
    """K − σM = LDLᵀ.

    A front with its own block A and the coupling B to its boundary leaves there the Schur complement C − BA⁻¹Bᵀ.

    Attributes:
        dissection: the elimination tree.
        downward: A⁻¹ above BA⁻¹ for each level, (fronts, s + r, s).
        upward: (BA⁻¹)ᵀ, (fronts, s, r).
        negative: how many eigenvalues are negative: by Sylvester's law of inertia, the number of the pencil's
            eigenvalues below σ.
    """

    dissection: Dissection
    downward: tuple[Float[Array, "fronts s_plus_r s"], ...]
    upward: tuple[Float[Array, "fronts s r"], ...]
    negative: Int[Array, ""]

    def solve(self, rhs: Float[Array, "b n_dof"]) -> Float[Array, "b n_dof"]:
        """Solve (K − σM) x = rhs for each row."""
        return _solve(self, rhs.T).T

    def solve_columns(self, rhs: Float[Array, "n_dof b"]) -> Float[Array, "n_dof b"]:
        """Solve (K − σM) x = rhs for each column."""
        return _solve(self, rhs)


def factorise(dissection: Dissection, pencil: Pencil, shift: Float[Array, ""]) -> Factorisation:
    """Factorise K − σM; what comes out is not finite where σ is an eigenvalue to rounding."""
    # Compiled without its result's dissection: what a compiled function hands through is copied.
    return Factorisation(dissection, *_eliminate(dissection, pencil, shift))


@jit_quickly()
def _eliminate(
    dissection: Dissection, pencil: Pencil, shift: Float[Array, ""]
) -> tuple[tuple[Array, ...], tuple[Array, ...], Int[Array, ""]]:
    """Return the matrices downward and upward, and the count of negative eigenvalues."""
    coefficients = _coefficients(pencil, shift)
    start = list(accumulate((math.prod(level.shape) for level in dissection.levels), initial=0))
    entries = jnp.zeros(start[-1], coefficients.dtype)
    entries = _put(entries, dissection.places, _anything(coefficients, dissection.entries))
    entries = _put(entries, dissection.padding, jnp.ones((), entries.dtype))
    downward, upward, pivots = [], [], []
    schur: Array | None = None
    for number, level in reversed(list(enumerate(dissection.levels))):
        _, _, s = level.shape
        blocks = entries[start[number] : start[number + 1]].reshape(level.shape)
        rest = jnp.zeros((), entries.dtype)
        if schur is not None:
            first, second = _gather_symmetric(schur, jnp.asarray(level.children))
            added = first + second
            blocks, rest = blocks + added[:, :, :s], added[:, s:, s:]
        inverse, found = symmetric_inverses(blocks[:, :s])
        coupling = jnp.matmul(blocks[:, s:], inverse, precision="highest")
        schur = rest - jnp.matmul(coupling, jnp.swapaxes(blocks[:, s:], 1, 2), precision="highest")
        downward.append(jnp.concatenate([inverse, coupling], axis=1))
        upward.append(jnp.swapaxes(coupling, 1, 2))
        pivots.append(found.ravel())
    return tuple(downward[::-1]), tuple(upward[::-1]), jnp.sum(jnp.concatenate(pivots) < 0)


@jax.jit
def _solve(factor: Factorisation, rhs: Float[Array, "n_dof b"]) -> Float[Array, "n_dof b"]:
    width = rhs.shape[1]
    own: list[Array] = []
    passed: Array | None = None
    for level, matrix in zip(factor.dissection.levels[::-1], factor.downward[::-1], strict=True):
        s = level.own.shape[1]
        force, onward = _anything(rhs, level.own), jnp.zeros((), rhs.dtype)
        if passed is not None:
            # What a child does not have is found in the row of zeros.
            padded = jnp.concatenate([passed, jnp.zeros((1, width), rhs.dtype)])
            total = _anything(padded, level.children[0]) + _anything(padded, level.children[1])
            force, onward = force + total[:, :s], total[:, s:]
        product = jnp.matmul(matrix, force, precision="highest")
        own.append(product[:, :s])
        passed = (onward - product[:, s:]).reshape(-1, width)
    solutions: list[Array] = []
    above = jnp.zeros((0, width), rhs.dtype)
    for level, matrix in zip(factor.dissection.levels, factor.upward, strict=True):
        boundary = _anything(above, level.boundary)
        x = own.pop() - jnp.matmul(matrix, boundary, precision="highest")
        above = jnp.concatenate([x, boundary], axis=1).reshape(-1, width)
        solutions.append(x.reshape(-1, width))
    return _anything(jnp.concatenate(solutions), factor.dissection.order)


def _coefficients(pencil: Pencil, shift: Float[Array, ""]) -> Float[Array, " entries"]:
    """Return the stencil coefficients of K − σM, flat."""
    stiffness, mass = pencil.stiffness, pencil.mass
    assert isinstance(stiffness, StencilOperator)
    coefficients = stiffness.coefficients
    if isinstance(mass, StencilOperator):
        return (coefficients - shift * mass.coefficients).reshape(-1)
    centre = coefficients.shape[0] // 2
    lumped = pencil.space.extend(mass.diagonal(), outside=0.0)
    return coefficients.at[centre].add(-shift * lumped).reshape(-1)


def _anything(x: Float[Array, "n *b"], index: Int[ArrayLike, "*m"]) -> Float[Array, "*m_and_b"]:
    """Return rows of x; whatever is there where the index is out of range, for products in which it meets zeros."""
    return x.at[index].get(mode="clip", wrap_negative_indices=False)


def _put(x: Float[Array, " n"], index: Int[ArrayLike, " m"], values: Float[Array, "*m"]) -> Float[Array, " n"]:
    return x.at[index].set(values, unique_indices=True, wrap_negative_indices=False)


def _gather_symmetric(
    blocks: Float[Array, "blocks r r"], index: Int[Array, "children fronts m"]
) -> Float[Array, "children fronts m m"]:
    """Return the entries of symmetric blocks at pairs of places (block · r + i, block · r + j); zero for padding."""
    n, r = blocks.shape[:2]
    there = index < n * r
    # Whole rows first, and of these the columns: faster than entry by entry.
    rows = jnp.where(there[..., None], _anything(blocks.reshape(-1, r), index), 0)
    columns = jnp.take_along_axis(rows, (index % r)[:, :, None, :], axis=3, mode="clip")
    return jnp.where(there[:, :, None, :], columns, 0)
