"""Matrices on grids: stencils, on nodal arrays and on degrees of freedom."""

import math
from collections.abc import Callable
from functools import reduce
from itertools import product
from operator import add, mul

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.fem.grid_pattern import GridPattern
from hks_jax.fem.halo import Slabs, neighbours, product_with_rim, side_by_side, with_rim
from hks_jax.fem.space import GridSpace, taken
from hks_jax.linear import accelerators
from hks_jax.linear.operators import OfColumns, PatternedOperator, Places
from hks_jax.linear.products import of_each_row


class Stencil(eqx.Module):
    """A matrix that couples a node of a grid to its 3^d neighbours, applied to nodal columns (*shape, b).

    In this layout each coefficient is read once for all columns: in 3D it is about twice as fast as row after row. What
    is compiled for one stencil serves all of its shape, whatever their masks.

    Attributes:
        coefficients: (3^d, *shape), offsets in the order of ``product((-1, 0, 1), repeat=d)``: the entry at o and i
            couples node i to i + offset(o). Or (1, *shape), a diagonal. Those across a side that is not periodic are 0.
        periodic: per axis, whether node n is node 0 again; static.
        slabs: how the grid is cut, where this is one device's share of it, inside of `shard_map`; static.
    """

    coefficients: Float[Array, "offsets *shape"]
    periodic: tuple[bool, ...] = eqx.field(static=True)
    slabs: Slabs | None = eqx.field(default=None, static=True)

    @property
    def is_diagonal(self) -> bool:
        """Whether there is a single coefficient per node, as a lumped mass has it."""
        return self.coefficients.shape[0] == 1

    def own(self, slabs: Slabs) -> "Stencil":
        """Return this device's share."""
        return Stencil(slabs.own(self.coefficients, 1), self.periodic, slabs)

    def __matmul__(self, x: Float[Array, "*shape b"]) -> Float[Array, "*shape b"]:
        """Return one product; for products in a loop, see `of_columns`."""
        return self.of_columns()(x)

    def of_columns(self) -> Callable[[Float[Array, "*shape b"]], Float[Array, "*shape b"]]:
        """Return the product with columns.

        What is done to the coefficients is done here: for products in a loop, call this outside.
        """
        apply = self.of_rimmed()
        return (lambda x: apply(x, x)) if self.is_diagonal else (lambda x: apply(x, self.rimmed(x)))

    def rimmed(self, x: Float[Array, "*shape b"]) -> Float[Array, "..."]:
        """Return columns together with their neighbours beyond the sides, as `of_rimmed` takes them."""
        if self.slabs is not None:
            return self.slabs.with_halo(x)
        if any(self.periodic):
            return with_rim(x, self.periodic)
        _, reach = _distances(x.shape[:-1])
        return jnp.pad(x.reshape(-1, x.shape[-1]), ((reach, reach), (0, 0)))

    def of_rimmed(self) -> Callable[[Float[Array, "*shape b"], Float[Array, "..."]], Float[Array, "*shape b"]]:
        """Return the product with columns x, given x and `rimmed` x, which several stencils can share."""
        if self.is_diagonal:
            return lambda x, _: self.coefficients[0][..., None] * x
        if self.slabs is not None or any(self.periodic):
            of_box = product_with_rim(self.coefficients)
            return lambda _, rimmed: of_box(rimmed)
        # Node after node in one row, a neighbour is a fixed distance away. Across the sides, where the row goes on
        # elsewhere, there is nothing: elements end there, and their entries were never written.
        distances, reach = _distances(self.coefficients.shape[1:])
        row = side_by_side(self.coefficients).reshape(-1, len(distances))
        nodes = len(row)
        # On accelerators an array for each offset, behind a barrier: XLA would take them apart anew for each product.
        apart = jax.lax.optimization_barrier(jnp.split(row, len(distances), axis=1)) if accelerators.at_hand() else ()

        def of_row(x: Float[Array, "*shape b"], padded: Float[Array, "padded b"]) -> Float[Array, "*shape b"]:
            b = x.shape[-1]
            y = jnp.zeros((), x.dtype)
            for o, distance in enumerate(distances):
                own = apart[o] if apart else row[:, o, None]
                y = y + own * jax.lax.slice(padded, (reach + distance, 0), (reach + distance + nodes, b))
            return y.reshape(x.shape)

        return of_row

    def outer(self, p: Float[Array, "*shape b"], x: Float[Array, "*shape b"]) -> Float[Array, "offsets *shape"]:
        """Return Σ_b p[i, b] x[i + o, b] for every offset: the derivative of Σ_b pᵀCx by the coefficients of C."""
        shifts = [x] if self.is_diagonal else neighbours(with_rim(x, self.periodic), len(self.periodic))
        return jnp.stack([jnp.sum(p * shifted, axis=-1) for shifted in shifts])


def _distances(shape: tuple[int, ...]) -> tuple[list[int], int]:
    """Return how far away each neighbour is where the nodes stand in one row, and the largest of these."""
    strides = [math.prod(shape[axis + 1 :]) for axis in range(len(shape))]
    distances = [sum(map(mul, offset, strides)) for offset in product((-1, 0, 1), repeat=len(shape))]
    return distances, distances[-1]


class StencilOperator(PatternedOperator):
    """A stencil on the free nodes of a grid: 9 coefficients a node in 2D, 27 in 3D.

    ``coefficients`` are those of a `Stencil`. Couplings to nodes that are not free are zero.
    """

    coefficients: Float[Array, "offsets *shape"]
    space: GridSpace = eqx.field(static=True)

    @property
    def pattern(self) -> GridPattern:
        """Where the entries are."""
        return GridPattern(self.space)

    @property
    def nodal(self) -> Stencil:
        """The matrix on nodal arrays."""
        return Stencil(self.coefficients, self.space.periodic)

    def flat(self) -> Float[Array, " m"]:
        """Return the coefficients."""
        return self.coefficients.reshape(-1)

    def with_flat(self, entries: Float[Array, " m"]) -> "StencilOperator":
        """Return the matrix with other coefficients."""
        return StencilOperator(entries.reshape(self.coefficients.shape), self.space)

    def apply(self, x: Float[Array, "... n_dof"]) -> Float[Array, "... n_dof"]:
        """Apply the operator along the last axis."""
        shape, coefficients = self.space.node_shape, list(self.coefficients)

        def product_with(row: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
            # Behind the barrier the neighbours are slices of an array, and not what decides of each node where it is.
            rimmed = jax.lax.optimization_barrier(with_rim(row, self.space.periodic))
            terms = zip(coefficients, neighbours(rimmed, len(shape)), strict=True)
            return reduce(add, (c * shifted for c, shifted in terms))

        rows = self.space.extend(x, outside=0.0).reshape(-1, *shape)
        return self.space.restrict(of_each_row(product_with, rows).reshape(*x.shape[:-1], *shape))

    def of_columns(self) -> OfColumns:
        """Return the product with a block of columns, twice as fast as with rows."""
        product_with, shape = self.nodal.of_columns(), self.space.node_shape
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
