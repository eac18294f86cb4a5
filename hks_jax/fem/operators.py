"""Matrices on grids: stencils."""

from functools import reduce
from operator import add

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from hks_jax.fem.columns import neighbours, stencil, with_rim
from hks_jax.fem.grid_pattern import GridPattern
from hks_jax.fem.space import GridSpace, taken
from hks_jax.linear.operators import OfColumns, PatternedOperator, Places
from hks_jax.linear.products import of_each_row


class StencilOperator(PatternedOperator):
    """A matrix that couples a node of a grid to its 3^d neighbours.

    ``coefficients[o]`` (*shape) couples every node x to x + offset(o), offsets in the order of
    ``itertools.product((-1, 0, 1), repeat=d)``: 9 coefficients a node in 2D, 27 in 3D. Couplings to nodes that are not
    free are zero.
    """

    coefficients: Float[Array, "offsets *shape"]
    space: GridSpace = eqx.field(static=True)

    @property
    def pattern(self) -> GridPattern:
        """Where the entries are."""
        return GridPattern(self.space)

    def flat(self) -> Float[Array, " m"]:
        """Return the coefficients."""
        return self.coefficients.reshape(-1)

    def with_flat(self, entries: Float[Array, " m"]) -> "StencilOperator":
        """Return the matrix with other coefficients."""
        return StencilOperator(entries.reshape(self.coefficients.shape), self.space)

    def apply_nodal(self, x: Float[Array, "*leading_and_shape"]) -> Float[Array, "*leading_and_shape"]:
        """Apply the operator to nodal arrays; rows and columns of nodes that are not free are zero."""
        shape, coefficients = self.space.node_shape, list(self.coefficients)

        def product_with(row: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
            # Behind the barrier the neighbours are slices of an array, and not what decides of each node where it is.
            rimmed = jax.lax.optimization_barrier(with_rim(row, self.space.periodic))
            terms = zip(coefficients, neighbours(rimmed, len(shape)), strict=True)
            return reduce(add, (c * shifted for c, shifted in terms))

        return of_each_row(product_with, x.reshape(-1, *shape)).reshape(x.shape)

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

    def triplets(self) -> tuple[Float[Array, " nnz"], Places]:
        """Return the entries and their static (rows, columns)."""
        where, rows, cols = self.pattern.places()
        return taken(self.flat(), where), (rows, cols)

    def diagonal(self) -> Float[Array, " n_dof"]:
        """Return the main diagonal."""
        return self.space.restrict(self.coefficients[self.coefficients.shape[0] // 2])
