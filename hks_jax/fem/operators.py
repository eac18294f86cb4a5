"""Symmetric linear operators on a function space: stencils on grids, triplets on meshes, diagonals."""

from abc import abstractmethod
from collections.abc import Callable
from functools import lru_cache
from itertools import product

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.sparse import coo_matrix, csc_matrix

from hks_jax.domain.static_array import StaticArray
from hks_jax.fem.columns import stencil
from hks_jax.fem.space import FunctionSpace, GridSpace

Pattern = tuple[np.ndarray, np.ndarray]
OfColumns = Callable[[Float[Array, "n_dof b"]], Float[Array, "n_dof b"]]

_ROWS, _LARGE = 8, 1 << 22
"""Large arrays are multiplied in blocks of so many rows, written out one by one: the transpose, which sums over the
rows, is then a fused sum and not a reduction, which XLA does many times slower on CPUs."""


class Operator(eqx.Module):
    """A symmetric matrix over the degrees of freedom, applied without being formed."""

    space: eqx.AbstractVar[FunctionSpace]

    @abstractmethod
    def apply(self, x: Float[Array, "... n_dof"]) -> Float[Array, "... n_dof"]:
        """Apply the operator along the last axis."""

    def of_columns(self) -> OfColumns:
        """Return the product with a block of columns; for products in a loop, call this outside."""
        return lambda x: self.apply(x.T).T

    @abstractmethod
    def triplets(self) -> tuple[Float[Array, " nnz"], Pattern]:
        """Return the entries and their static (rows, columns); repeated positions add up."""

    @property
    def shape(self) -> tuple[int, int]:
        """(n_dof, n_dof)."""
        return (self.space.n_dof, self.space.n_dof)

    @property
    def dtype(self) -> np.dtype:
        """The dtype of the entries."""
        return jax.tree.leaves(self)[0].dtype

    def diagonal(self) -> Float[Array, " n_dof"]:
        """Return the main diagonal."""
        data, (rows, cols) = self.triplets()
        on = np.flatnonzero(rows == cols)
        return jnp.zeros(self.space.n_dof, data.dtype).at[rows[on]].add(data[on])

    def __matmul__(self, x: Float[Array, "n_dof *m"]) -> Float[Array, "n_dof *m"]:
        """Multiply a vector (n_dof,) or a block of columns (n_dof, m)."""
        if x.ndim not in (1, 2) or x.shape[0] != self.space.n_dof:
            raise ValueError(
                f"@: got an array of shape {x.shape}; expected ({self.space.n_dof},) or ({self.space.n_dof}, m)"
            )
        return self.apply(x.T).T

    def to_dense(self) -> Float[Array, "n_dof n_dof"]:
        """Return the full matrix."""
        data, (rows, cols) = self.triplets()
        return jnp.zeros(self.shape, data.dtype).at[rows, cols].add(data)

    def to_scipy(self) -> csc_matrix:
        """Return the matrix as SciPy CSC, on the host."""
        data, pattern = self.triplets()
        return coo_matrix((np.asarray(data), pattern), shape=self.shape).tocsc()


class StencilOperator(Operator):
    """A matrix that couples a node of a grid to its 3^d neighbours.

    ``coefficients[o]`` (*shape) couples every node x to x + offset(o), offsets in the order of
    ``itertools.product((-1, 0, 1), repeat=d)``: 9 coefficients a node in 2D, 27 in 3D. Couplings to nodes that are not
    free are zero.
    """

    coefficients: Float[Array, "offsets *shape"]
    space: GridSpace = eqx.field(static=True)

    def apply_nodal(self, x: Float[Array, "*leading_and_shape"]) -> Float[Array, "*leading_and_shape"]:
        """Apply the operator to nodal arrays; rows and columns of nodes that are not free are zero."""
        shape = self.space.node_shape
        rows, coefficients = x.reshape(-1, *shape), list(self.coefficients)

        # The shifted copies are made again in the transpose: kept, they would be 3^d arrays of the size of x.
        @jax.checkpoint
        def product_with(some: Float[Array, "*rows_and_shape"]) -> Float[Array, "*rows_and_shape"]:
            y = jnp.zeros((), x.dtype)
            for c, offset in zip(coefficients, product((-1, 0, 1), repeat=len(shape)), strict=True):
                y = y + c * _neighbours(some, offset, self.space.periodic)
            return y

        whole = rows.shape[0] - rows.shape[0] % _ROWS
        if rows.size < _LARGE or whole == 0:
            return product_with(rows).reshape(x.shape)
        blocks = rows[:whole].reshape(-1, _ROWS, *shape)
        done = jax.lax.map(lambda block: jnp.stack([product_with(row) for row in block]), blocks)
        return jnp.concatenate([done.reshape(whole, *shape), product_with(rows[whole:])]).reshape(x.shape)

    def apply(self, x: Float[Array, "... n_dof"]) -> Float[Array, "... n_dof"]:
        """Apply the operator along the last axis."""
        return self.space.restrict(self.apply_nodal(self.space.extend(x, outside=0.0)))

    def of_columns(self) -> OfColumns:
        """Return the product with a block of columns, twice as fast as with rows."""
        product_with, shape = stencil(self.coefficients, self.space.periodic), self.space.node_shape
        free, numbers = np.flatnonzero(self.space.free), self.space.degrees_of_freedom
        if free.size == numbers.size:
            return lambda x: product_with(x.reshape(*shape, -1)).reshape(x.shape)
        numbers = np.where(numbers < 0, free.size, numbers)  # out of range, where there is none

        def product_of_free(x: Float[Array, "n_dof b"]) -> Float[Array, "n_dof b"]:
            nodal = x.at[numbers].get(mode="fill", fill_value=0)
            return product_with(nodal.reshape(*shape, -1)).reshape(nodal.shape)[free]

        return product_of_free

    def triplets(self) -> tuple[Float[Array, " nnz"], Pattern]:
        """Return the entries and their static (rows, columns)."""
        where, pattern = stencil_pattern(self.space)
        return self.coefficients.reshape(-1)[where], pattern

    def diagonal(self) -> Float[Array, " n_dof"]:
        """Return the main diagonal."""
        return self.space.restrict(self.coefficients[self.coefficients.shape[0] // 2])


def _neighbours(x: Array, offset: tuple[int, ...], periodic: tuple[bool, ...]) -> Array:
    """Return the neighbours' values, y[i] = x[i + offset], over the last axes; 0 beyond the grid's sides."""
    first = x.ndim - len(offset)
    for axis, (o, wraps) in enumerate(zip(offset, periodic, strict=True), start=first):
        if o == 0:
            continue
        # Padding by −1 on one side and 1 on the other is a shift that XLA fuses with the product.
        y = _placed(x, axis, -o, o)
        if wraps:
            n = x.shape[axis]
            edge = jax.lax.slice_in_dim(x, 0, 1, axis=axis) if o > 0 else jax.lax.slice_in_dim(x, n - 1, n, axis=axis)
            y = y + (_placed(edge, axis, n - 1, 0) if o > 0 else _placed(edge, axis, 0, n - 1))
        x = y
    return x


def _placed(x: Array, axis: int, before: int, after: int) -> Array:
    return jax.lax.pad(
        x, jnp.zeros((), x.dtype), [(before, after, 0) if a == axis else (0, 0, 0) for a in range(x.ndim)]
    )


@lru_cache(maxsize=16)
def stencil_pattern(space: GridSpace) -> tuple[np.ndarray, Pattern]:
    """Where in the coefficients each entry lies, and its (row, column), for the couplings between free nodes."""
    shape, d = space.node_shape, space.dimension
    number = space.degrees_of_freedom.reshape(shape).astype(np.int32)
    for axis, wraps in enumerate(space.periodic):
        widths = [(1, 1) if a == axis else (0, 0) for a in range(d)]
        number = np.pad(number, widths, mode="wrap") if wraps else np.pad(number, widths, constant_values=-1)
    centre = number[(slice(1, -1),) * d].ravel()
    where, rows, cols = [], [], []
    for o, start in enumerate(product((0, 1, 2), repeat=d)):
        neighbour = number[tuple(slice(s, s + n) for s, n in zip(start, shape, strict=True))].ravel()
        both = np.flatnonzero((centre >= 0) & (neighbour >= 0))
        where.append(o * centre.size + both)
        rows.append(centre[both])
        cols.append(neighbour[both])
    return np.concatenate(where), (np.concatenate(rows), np.concatenate(cols))


class SparseOperator(Operator):
    """A matrix given by its entries at static positions (rows, columns)."""

    data: Float[Array, " nnz"]
    space: FunctionSpace = eqx.field(static=True)
    rows: StaticArray = eqx.field(static=True)
    cols: StaticArray = eqx.field(static=True)

    def apply(self, x: Float[Array, "... n_dof"]) -> Float[Array, "... n_dof"]:
        """Apply the operator along the last axis."""
        terms = self.data * x[..., self.cols.value]
        summed = jax.ops.segment_sum(
            jnp.moveaxis(terms, -1, 0), self.rows.value, self.space.n_dof, indices_are_sorted=True
        )
        return jnp.moveaxis(summed, 0, -1)

    def triplets(self) -> tuple[Float[Array, " nnz"], Pattern]:
        """Return the entries and their static (rows, columns)."""
        return self.data, (self.rows.value, self.cols.value)


class DiagonalOperator(Operator):
    """A diagonal matrix, such as the lumped mass."""

    entries: Float[Array, " n_dof"]
    space: FunctionSpace = eqx.field(static=True)

    def apply(self, x: Float[Array, "... n_dof"]) -> Float[Array, "... n_dof"]:
        """Apply the operator along the last axis."""
        return self.entries * x

    def of_columns(self) -> OfColumns:
        """Return the product with a block of columns."""
        return lambda x: self.entries[:, None] * x

    def triplets(self) -> tuple[Float[Array, " nnz"], Pattern]:
        """Return the entries and their static (rows, columns)."""
        index = np.arange(self.space.n_dof)
        return self.entries, (index, index)
