"""How the kernel Φ C Φᵀ of a spectral function, C (k, k), is read: diagonal, columns, distances, flows."""

from abc import abstractmethod
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from hks_jax.fem.space import FunctionSpace
from hks_jax.linear.linear_map import with_transpose
from hks_jax.linear.products import products_with_columns, row_blocks
from hks_jax.static_array import StaticArray

_ROWS = 64
"""Functions whose products with all others are computed together, or left out."""


class Contraction(eqx.Module):
    """A reading of Φ C Φᵀ; what it depends on linearly is its leaves."""

    @abstractmethod
    def weighted(self, weights: Float[Array, "m k"], vectors: Float[Array, "k n"]) -> Float[Array, "m *s n"]:
        """Return the reading for each diagonal C = diag(weights)."""

    @abstractmethod
    def mixed(
        self, matrix: Float[Array, "k k"], vectors: Float[Array, "k n"], matters: Bool[Array, " k"]
    ) -> Float[Array, "*s n"]:
        """Return the reading for one symmetric C, zero between functions that do not matter."""


class Diagonal(Contraction):
    """(Φ C Φᵀ)(x, x)."""

    def weighted(self, weights: Float[Array, "m k"], vectors: Float[Array, "k n"]) -> Float[Array, "m n"]:
        """Return Σᵢ cᵢ φᵢ(x)²."""
        return _matmul(weights, jnp.square(vectors))

    # At large times only the first few functions matter. Of C the rows up to the last of them are enough, with twice
    # the entries in columns that do not matter. The transpose has its large factor on the left, where XLA is fastest.
    def mixed(
        self, matrix: Float[Array, "k k"], vectors: Float[Array, "k n"], matters: Bool[Array, " k"]
    ) -> Float[Array, " n"]:
        """Return Σᵢⱼ Cᵢⱼ φᵢ(x) φⱼ(x)."""
        (k, n), size = vectors.shape, min(_ROWS, len(vectors))
        starts, _ = row_blocks(k, size)
        rows = starts[:, None] + np.arange(size)
        used = matters[rows] & (rows >= size * np.arange(len(starts))[:, None])  # each row once
        blocks = jnp.where(used[..., None], jnp.where(matters, matrix, 2 * matrix)[rows], 0)
        count = jnp.max(jnp.where(jnp.any(used, axis=1), np.arange(1, len(starts) + 1), 0))

        def own(number: Array) -> Float[Array, "size n"]:
            return jax.lax.dynamic_slice_in_dim(vectors, jnp.asarray(starts)[number], size)

        def forward(blocks: Float[Array, "blocks size k"]) -> Float[Array, " n"]:
            def add(number: Array, total: Array) -> Array:
                return total + jnp.sum(own(number) * _matmul(blocks[number], vectors), axis=0)

            return jax.lax.fori_loop(0, count, add, jnp.zeros(n, vectors.dtype))

        def backward(weights: Float[Array, " n"]) -> Float[Array, "blocks size k"]:
            def put(number: Array, blocks: Array) -> Array:
                columns = jax.lax.optimization_barrier((own(number) * weights).T)
                return blocks.at[number].set(products_with_columns(vectors, columns).T)

            return jax.lax.fori_loop(0, count, put, jnp.zeros((*rows.shape, k), vectors.dtype))

        return with_transpose(forward, backward, blocks)


class _FromSources(Contraction):
    space: FunctionSpace = eqx.field(static=True)
    sources: StaticArray = eqx.field(static=True)

    def at_sources(self, vectors: Float[Array, "k n"]) -> Float[Array, "k s"]:
        """Return the functions' values at the source nodes (flat node indices): 0 at Dirichlet nodes."""
        degrees = self.space.degrees_of_freedom[self.sources.value]
        return jnp.where(degrees >= 0, vectors[:, degrees], 0)


class Columns(_FromSources):
    """(Φ C Φᵀ)(x_s, x) for source nodes x_s."""

    def weighted(self, weights: Float[Array, "m k"], vectors: Float[Array, "k n"]) -> Float[Array, "m s n"]:
        """Return Σᵢ cᵢ φᵢ(x_s) φᵢ(x)."""
        return _matmul(weights[:, None, :] * self.at_sources(vectors).T, vectors)

    def mixed(
        self, matrix: Float[Array, "k k"], vectors: Float[Array, "k n"], matters: Bool[Array, " k"]
    ) -> Float[Array, "s n"]:
        """Return Σᵢⱼ Cᵢⱼ φᵢ(x_s) φⱼ(x)."""
        return _matmul(_matmul(self.at_sources(vectors).T, matrix), vectors)


class SquaredDistances(_FromSources):
    """The squared distance that C induces from source nodes: C between φ(x) − φ(x_s) and itself, at all nodes x.

    The sum of squared differences: expanded, its terms would cancel to nothing at large times.
    """

    def weighted(self, weights: Float[Array, "m k"], vectors: Float[Array, "k n"]) -> Float[Array, "m s nodes"]:
        """Return Σᵢ cᵢ (φᵢ(x) − φᵢ(x_s))²."""
        return jnp.moveaxis(self._map(vectors, lambda apart: _matmul(weights, jnp.square(apart))), 0, 1)

    def mixed(
        self, matrix: Float[Array, "k k"], vectors: Float[Array, "k n"], matters: Bool[Array, " k"]
    ) -> Float[Array, "s nodes"]:
        """Return Σᵢⱼ Cᵢⱼ (φᵢ(x) − φᵢ(x_s)) (φⱼ(x) − φⱼ(x_s))."""
        return self._map(vectors, lambda apart: jnp.sum(apart * _matmul(matrix, apart), axis=0))

    def _map(self, vectors: Float[Array, "k n"], reading: Callable[[Array], Array]) -> Array:
        nodal = self.space.extend(vectors, outside=0.0).reshape(vectors.shape[0], -1)
        return jax.lax.map(lambda source: reading(nodal - source[:, None]), self.at_sources(vectors).T)


class Applied(Contraction):
    """Φ C Φᵀ w for functionals w.

    Attributes:
        functionals: (s, n).
        part: (k,) the part of a doubled problem that a function is of; the functionals act on those of part 0.
    """

    functionals: Float[Array, "s n"]
    part: Int[Array, " k"]

    def weighted(self, weights: Float[Array, "m k"], vectors: Float[Array, "k n"]) -> Float[Array, "m s n"]:
        """Return Σᵢ cᵢ (φᵢ·w) φᵢ(x)."""
        return _matmul(weights[:, None, :] * self._coefficients(vectors), vectors)

    def mixed(
        self, matrix: Float[Array, "k k"], vectors: Float[Array, "k n"], matters: Bool[Array, " k"]
    ) -> Float[Array, "s n"]:
        """Return Σᵢⱼ Cᵢⱼ (φᵢ·w) φⱼ(x)."""
        return _matmul(_matmul(self._coefficients(vectors), matrix), vectors)

    def along(self, tangent: "Contraction") -> "Applied":
        """Return the reading's derivative along a tangent of itself: it is linear in the functionals."""
        assert isinstance(tangent, Applied)
        return Applied(tangent.functionals, self.part)

    def _coefficients(self, vectors: Float[Array, "k n"]) -> Float[Array, "s k"]:
        return jnp.where(self.part == 0, _matmul(self.functionals, vectors.T), 0)


def _matmul(a: Array, b: Array) -> Array:
    return jnp.matmul(a, b, precision="highest")
