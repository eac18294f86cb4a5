"""Symmetric linear operators: sparse matrices with a static pattern, and diagonal matrices."""

from abc import abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Inexact
from scipy.sparse import coo_matrix, csc_matrix

from hks_jax.compilation import jit_quickly
from hks_jax.linear.pattern import Ellpack, Pattern, SparsePattern
from hks_jax.linear.products import aligned, of_each_row

Places = tuple[np.ndarray, np.ndarray]
OfColumns = Callable[[Float[Array, "n_dof b"]], Float[Array, "n_dof b"]]

_PLACES = 1 << 12
"""The number of entries of Σ pxᵀ that are computed per step; the parts of p and x for a step fit into the cache."""
_RUN = 8
"""Slices are faster than indices if runs of entries at one distance to the diagonal are longer than this on average."""
ROUNDING = 1000
"""The largest accepted asymmetry of a matrix, in units of ε times its largest entry."""


class Operator(eqx.Module):
    """A symmetric matrix, applied without forming the full matrix."""

    @property
    @abstractmethod
    def size(self) -> int:
        """The number of rows, n_dof."""

    @abstractmethod
    def apply(self, x: Float[Array, "... n_dof"]) -> Float[Array, "... n_dof"]:
        """Apply the operator along the last axis."""

    @abstractmethod
    def of_columns(self) -> OfColumns:
        """Return the function that multiplies a block of columns; for products in a loop, call this before the loop."""

    @abstractmethod
    def triplets(self) -> tuple[Float[Array, " nnz"], Places]:
        """Return the entries and their static (rows, columns)."""

    @abstractmethod
    def outer(self, p: Float[np.ndarray, "b n_dof"], x: Float[np.ndarray, "b n_dof"]) -> "Operator":
        """Return Σ pxᵀ on the sparsity pattern, by NumPy: the derivative of Σ p·Ax with respect to A."""

    @property
    def shape(self) -> tuple[int, int]:
        """The shape (n_dof, n_dof)."""
        return (self.size, self.size)

    @property
    def dtype(self) -> np.dtype:
        """The dtype of the entries."""
        return jax.tree.leaves(self)[0].dtype

    def diagonal(self) -> Float[Array, " n_dof"]:
        """Return the main diagonal."""
        data, (rows, cols) = self.triplets()
        on = np.flatnonzero(rows == cols)
        return jnp.zeros(self.size, data.dtype).at[rows[on]].add(data[on])

    def __matmul__(self, x: Float[Array, "n_dof *m"]) -> Float[Array, "n_dof *m"]:
        """Multiply a vector (n_dof,) or a block of columns (n_dof, m)."""
        if x.ndim not in (1, 2) or x.shape[0] != self.size:
            raise ValueError(f"@: got an array of shape {x.shape}; expected ({self.size},) or ({self.size}, m)")
        return _product(self, x)

    def to_dense(self) -> Float[Array, "n_dof n_dof"]:
        """Return the full matrix."""
        return _scattered(*self.triplets(), self.shape)

    def to_scipy(self) -> csc_matrix:
        """Return the matrix as SciPy CSC, on the host."""
        data, places = self.triplets()
        return coo_matrix((np.asarray(data), places), shape=self.shape).tocsc()


@jit_quickly()
def _product(operator: Operator, x: Float[Array, "n_dof *m"]) -> Float[Array, "n_dof *m"]:
    return operator.apply(x.T).T


# The places are arguments, so that another pattern of the same size needs no compilation.
@partial(jax.jit, static_argnames="shape")
def _scattered(data: Float[Array, " nnz"], places: Any, shape: tuple[int, int]) -> Float[Array, "rows cols"]:
    return jnp.zeros(shape, data.dtype).at[places].add(data)


class PatternedOperator(Operator):
    """A matrix with a static sparsity pattern, which can be factorised."""

    @property
    @abstractmethod
    def pattern(self) -> Pattern:
        """The sparsity pattern; static."""

    @abstractmethod
    def flat(self) -> Float[Array, " m"]:
        """Return the entries as one array, in the order to which the indices of the pattern refer."""

    @abstractmethod
    def with_flat(self, entries: Float[Array, " m"]) -> "PatternedOperator":
        """Return the matrix with other entries at the same places."""

    def outer(self, p: Float[np.ndarray, "b n_dof"], x: Float[np.ndarray, "b n_dof"]) -> "PatternedOperator":
        """Return Σ pxᵀ on the sparsity pattern, by NumPy."""
        where, rows, cols = self.pattern.places()
        entries = np.zeros(where.size, x.dtype)
        starts = np.flatnonzero((np.diff(rows, prepend=-2) != 1) | (np.diff(cols, prepend=-2) != 1))
        if where.size > _RUN * starts.size:  # along an axis of a grid, rows and columns advance together
            runs = zip(rows[starts], cols[starts], starts, np.diff(starts, append=where.size), strict=True)
            for i, j, start, n in sorted(runs):  # by rows, so that parts of p and x stay in the cache
                np.einsum("bi,bi->i", p[:, i : i + n], x[:, j : j + n], out=entries[start : start + n])
        else:
            p, x = np.ascontiguousarray(p.T), np.ascontiguousarray(x.T)
            for first in range(0, where.size, _PLACES):
                some = slice(first, first + _PLACES)
                entries[some] = np.einsum("ib,ib->i", p[rows[some]], x[cols[some]])
        flat = np.zeros(self.pattern.n_entries, x.dtype)
        flat[where] = entries
        return self.with_flat(jax.device_put(flat))

    def plus(self, diagonal: Float[Array | np.ndarray, " n"]) -> "PatternedOperator":
        """Return the sum with a diagonal matrix, given as an array (n_dof,)."""
        if np.shape(diagonal) != (self.size,):
            raise ValueError(f"diagonal: got shape {np.shape(diagonal)}; expected {(self.size,)}, one number per row")
        minus = DiagonalOperator(-jnp.asarray(diagonal, self.dtype))
        return self.with_flat(shifted(self, minus, jnp.ones((), self.dtype)))

    @property
    def size(self) -> int:
        """The number of rows, n_dof."""
        return self.pattern.size


class SparseOperator(PatternedOperator):
    """A sparse matrix with an arbitrary symmetric pattern.

    Attributes:
        entries: the entries (m,) in the order of the pattern.
        structure: the pattern; static.
        table: the pattern's table as arrays, which are arguments of compiled functions. If ``table`` is None, compiled
            functions contain the table as a constant, which for a million rows adds seconds to each compilation.
    """

    entries: Float[Array, " m"]
    structure: SparsePattern = eqx.field(static=True)
    table: Ellpack | None = None

    @property
    def pattern(self) -> SparsePattern:
        """The sparsity pattern; static."""
        return self.structure

    def flat(self) -> Float[Array, " m"]:
        """Return the entries."""
        return self.entries

    def with_flat(self, entries: Float[Array, " m"]) -> "SparseOperator":
        """Return the matrix with other entries at the same places."""
        return SparseOperator(entries, self.structure, self.table)

    @jax.jit
    def symmetric_part(self) -> "SparseOperator":
        """Return (A + Aᵀ)/2, so that also in derivatives, entries (i, j) and (j, i) are one parameter."""
        return self.with_flat((self.entries + self.entries[self.pattern.across]) / 2)

    @property
    def _places(self) -> Ellpack:
        return self.pattern.table if self.table is None else self.table

    def diagonal(self) -> Float[Array, " n_dof"]:
        """Return the main diagonal."""
        return self.entries[self._places.diagonal]

    def apply(self, x: Float[Array, "... n_dof"]) -> Float[Array, "... n_dof"]:
        """Apply the operator along the last axis."""
        return of_each_row(self.of_columns(), x.reshape(-1, self.size)).reshape(x.shape)

    def of_columns(self) -> OfColumns:
        """Return the product with a block of columns or with a vector, as a function."""
        table = self._places
        ordered = list(self.entries.at[table.entries].get(mode="fill", fill_value=0, wrap_negative_indices=False))

        def product(x: Float[Array, "n_dof *b"]) -> Float[Array, "n_dof *b"]:
            y, one_each = jnp.zeros((), x.dtype), (-1, *[1] * (x.ndim - 1))
            for entries, cols in zip(ordered, table.cols, strict=True):
                y = y + entries.reshape(one_each) * x.at[cols].get(mode="promise_in_bounds")
            if len(table.others):
                terms = self.entries[table.others].reshape(one_each) * x[table.other_cols]
                y = y + jax.ops.segment_sum(terms, table.other_rows, self.size, indices_are_sorted=True)
            return y

        return product

    def triplets(self) -> tuple[Float[Array, " nnz"], Places]:
        """Return the entries and their static (rows, columns)."""
        return self.entries, (self.pattern.rows, self.pattern.cols)


class DiagonalOperator(Operator):
    """A diagonal matrix, such as the lumped mass."""

    entries: Float[Array, " n_dof"]

    @property
    def size(self) -> int:
        """The number of rows, n_dof."""
        return self.entries.shape[0]

    def outer(self, p: Float[np.ndarray, "b n_dof"], x: Float[np.ndarray, "b n_dof"]) -> "DiagonalOperator":
        """Return the diagonal of Σ pxᵀ, by NumPy."""
        return DiagonalOperator(jax.device_put(np.einsum("bi,bi->i", p, x)))

    def apply(self, x: Float[Array, "... n_dof"]) -> Float[Array, "... n_dof"]:
        """Apply the operator along the last axis."""
        return aligned(self.entries, x) * x

    def of_columns(self) -> OfColumns:
        """Return the product with a block of columns."""
        return lambda x: self.entries[:, None] * x

    def triplets(self) -> tuple[Float[Array, " nnz"], Places]:
        """Return the entries and their static (rows, columns)."""
        index = np.arange(self.size)
        return self.entries, (index, index)


@jit_quickly()
def shifted(stiffness: PatternedOperator, mass: Operator, shift: Inexact[Array, ""]) -> Inexact[Array, " m"]:
    """Return the entries of K − σM at the places of K's pattern, which contains M's; σ may be complex."""
    dtype = np.result_type(stiffness.dtype, shift.dtype)
    entries = stiffness.flat().astype(dtype)
    if isinstance(mass, PatternedOperator):
        assert mass.pattern == stiffness.pattern
        return entries - shift * mass.flat().astype(dtype)
    change = -shift * mass.diagonal().astype(dtype)
    return entries.at[stiffness.pattern.diagonal()].add(change, unique_indices=True)


def require_symmetric(
    name: str, values: Any, places: Places, size: int, remedy: str, limit: float | None = None
) -> None:
    """Raise ValueError unless a matrix is finite and symmetric. Entries with the same row and column are added.

    The largest accepted asymmetry is ``limit`` times the largest entry; by default, ``limit`` is `ROUNDING` times ε.
    """
    data, (rows, cols) = np.asarray(values), places
    wrong = int((~np.isfinite(data)).sum())
    if wrong:
        raise ValueError(f"{name}: {wrong} of {data.size} entries are NaN or infinite; expected finite numbers")
    held = coo_matrix((data, (rows, cols)), shape=(size, size)).tocsr()
    difference = abs(held - held.T).tocoo()
    limit = ROUNDING * float(np.finfo(data.dtype).eps) if limit is None else limit
    if difference.nnz and difference.data.max() > limit * np.max(np.abs(data)):
        at = int(np.argmax(difference.data))
        i, j = int(difference.row[at]), int(difference.col[at])
        raise ValueError(
            f"{name}: not symmetric: entry ({i}, {j}) is {held[i, j]:.6g}, and entry ({j}, {i}) differs from it by "
            f"{difference.data[at]:.2g}, more than {limit:.2g} of the largest entry. {remedy}"
        )
