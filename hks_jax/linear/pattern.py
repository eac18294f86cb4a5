"""Sparsity patterns of symmetric matrices. A pattern determines the structure of factorisations and products."""

from abc import abstractmethod
from functools import cached_property
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Int

from hks_jax.arrays import ByKey, StaticArray
from hks_jax.linear.bisection import Parts, bisect_graph


class Pattern:
    """The positions at which a symmetric matrix may have nonzero entries. Static and hashable."""

    size: int  # the number of rows
    n_entries: int  # the size of the array of entries

    @abstractmethod
    def places(self) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"], Int[np.ndarray, " m"]]:
        """For each entry of the pattern, return its index in the array of entries, its row, and its column."""

    @abstractmethod
    def diagonal(self) -> Int[np.ndarray, " n"]:
        """Return the indices of the diagonal entries."""

    @abstractmethod
    def bisect(self) -> Parts:
        """Return a recursive bisection of the matrix's graph, for nested dissection."""


class Ellpack(NamedTuple):
    """A pattern in ELLPACK format: a table with a few slots for each matrix row, and a list of further entries."""

    entries: Int[np.ndarray | Array, "width n"]  # indices of the entries in the table; out of range for empty slots
    cols: Int[np.ndarray | Array, "width n"]  # the columns of these entries
    others: Int[np.ndarray | Array, " m"]  # indices of the entries outside the table
    other_rows: Int[np.ndarray | Array, " m"]  # the rows of the entries outside the table
    other_cols: Int[np.ndarray | Array, " m"]  # the columns of the entries outside the table
    diagonal: Int[np.ndarray | Array, " n"]  # the indices of the diagonal entries


_SCATTERED = 3
"""The cost of an entry outside the table in a product, relative to an entry in the table."""


@jax.tree_util.register_static
class SparsePattern(ByKey, Pattern):
    """A symmetric pattern with a full diagonal. Entries are sorted by row, then by column."""

    rows: Int[np.ndarray, " m"]  # the row of each entry
    cols: Int[np.ndarray, " m"]  # the column of each entry

    def __init__(self, size: int, rows: Int[np.ndarray, " m"], cols: Int[np.ndarray, " m"]) -> None:
        places = StaticArray(rows, np.int32), StaticArray(cols, np.int32)
        self.size, self.n_entries, self._key = size, len(rows), (size, *places)
        self.rows, self.cols = (each.value for each in places)

    def places(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """For each entry of the pattern, return its index in the array of entries, its row, and its column."""
        return np.arange(self.rows.size, dtype=np.int32), self.rows, self.cols

    def diagonal(self) -> Int[np.ndarray, " n"]:
        """Return the indices of the diagonal entries."""
        return np.flatnonzero(self.rows == self.cols)

    def bisect(self) -> Parts:
        """Return a recursive bisection of the matrix's graph."""
        return bisect_graph(self.size, self.rows, self.cols)

    @cached_property
    def across(self) -> Int[np.ndarray, " m"]:
        """For each entry (i, j), the index of the entry (j, i)."""
        return np.lexsort((self.rows, self.cols)).astype(np.int32)

    @cached_property
    def table(self) -> Ellpack:
        """The pattern as a table, whose width minimises the cost of products even if a few rows are long."""
        counts = np.bincount(self.rows, minlength=self.size)
        start = np.cumsum(counts) - counts
        longer = np.cumsum(np.bincount(counts)[::-1])[::-1][1:]  # longer[w] rows have more than w entries
        left = np.cumsum(longer[::-1])[::-1]  # left[w] entries do not fit into a table with w slots for each row
        left = np.append(left, 0)
        width = int(np.argmin(np.arange(left.size) * self.size + _SCATTERED * left))
        slot = np.arange(width)[:, None]
        valid = slot < counts
        entries = np.where(valid, start + slot, self.rows.size)
        cols = np.where(valid, self.cols[np.where(valid, entries, 0)], 0)
        others = np.flatnonzero(np.arange(self.rows.size) - start[self.rows] >= width)
        fields = entries, cols, others, self.rows[others], self.cols[others], self.diagonal()
        return Ellpack(*(field.astype(np.int32) for field in fields))
