"""Linear functionals of the kernel Φ C Φᵀ of a spectral function: its diagonal, columns, distances and flows."""

from abc import abstractmethod
from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from hks_jax.arrays import StaticArray
from hks_jax.fem.space import FunctionSpace
from hks_jax.linear.products import quadratic_forms

_matmul = partial(jnp.matmul, precision="highest")


class Contraction(eqx.Module):
    """Values computed from the kernel Φ C Φᵀ with C (k, k). They are linear in the array leaves of this object."""

    @abstractmethod
    def weighted(self, weights: Float[Array, "m k"], vectors: Float[Array, "k n"]) -> Float[Array, "m *s n"]:
        """Return the values for each diagonal matrix C = diag(weights)."""

    @abstractmethod
    def mixed(
        self, matrices: Float[Array, "m k k"], vectors: Float[Array, "k n"], matters: Bool[Array, "m k"]
    ) -> Float[Array, "m *s n"]:
        """Return the values for each symmetric C. Its entries are negligible where neither row nor column matters."""


class Diagonal(Contraction):
    """The diagonal (Φ C Φᵀ)(x, x) of the kernel."""

    def weighted(self, weights: Float[Array, "m k"], vectors: Float[Array, "k n"]) -> Float[Array, "m n"]:
        """Return Σᵢ cᵢ φᵢ(x)²."""
        return _matmul(weights, jnp.square(vectors))

    def mixed(
        self, matrices: Float[Array, "m k k"], vectors: Float[Array, "k n"], matters: Bool[Array, "m k"]
    ) -> Float[Array, "m n"]:
        """Return Σᵢⱼ Cᵢⱼ φᵢ(x) φⱼ(x)."""
        return quadratic_forms(matrices, vectors, matters)


class _Bilinear(Contraction):
    """Sums Σᵢⱼ Cᵢⱼ aᵢ φⱼ(x), whose coefficients a (s, k) are linear in the eigenfunctions."""

    @abstractmethod
    def coefficients(self, vectors: Float[Array, "k n"]) -> Float[Array, "s k"]:
        """Return the coefficients a (s, k)."""

    def weighted(self, weights: Float[Array, "m k"], vectors: Float[Array, "k n"]) -> Float[Array, "m s n"]:
        """Return Σᵢ cᵢ aᵢ φᵢ(x)."""
        return _matmul(weights[:, None, :] * self.coefficients(vectors), vectors)

    def mixed(
        self, matrices: Float[Array, "m k k"], vectors: Float[Array, "k n"], matters: Bool[Array, "m k"]
    ) -> Float[Array, "m s n"]:
        """Return Σᵢⱼ Cᵢⱼ aᵢ φⱼ(x)."""
        return _matmul(_matmul(self.coefficients(vectors), matrices), vectors)


class Applied(_Bilinear):
    """The products Φ C Φᵀ w of the kernel with functionals w.

    Attributes:
        functionals: (s, n) the s functionals w.
    """

    functionals: Float[Array, "s n"]

    def coefficients(self, vectors: Float[Array, "k n"]) -> Float[Array, "s k"]:
        """Return the inner products φᵢ·w."""
        return _matmul(self.functionals, vectors.T)


class _FromSources(Contraction):
    space: FunctionSpace = eqx.field(static=True)
    sources: StaticArray = eqx.field(static=True)

    def coefficients(self, vectors: Float[Array, "k n"]) -> Float[Array, "s k"]:
        """Return the values φᵢ(x_s) at the source nodes, given as flat indices; they are 0 at Dirichlet nodes."""
        degrees = self.space.degrees_of_freedom[self.sources.value]
        return jnp.where(degrees >= 0, vectors[:, degrees], 0).T


class Columns(_FromSources, _Bilinear):
    """The columns (Φ C Φᵀ)(x_s, x) of the kernel for source nodes x_s."""


class SquaredDistances(_FromSources):
    """The squared distances (φ(x) − φ(x_s))ᵀ C (φ(x) − φ(x_s)) between source nodes x_s and all nodes x.

    The differences are formed before they are squared, because the expanded terms would cancel at large times.
    """

    def weighted(self, weights: Float[Array, "m k"], vectors: Float[Array, "k n"]) -> Float[Array, "m s nodes"]:
        """Return Σᵢ cᵢ (φᵢ(x) − φᵢ(x_s))²."""
        return self._map(vectors, lambda apart: _matmul(weights, jnp.square(apart)))

    def mixed(
        self, matrices: Float[Array, "m k k"], vectors: Float[Array, "k n"], matters: Bool[Array, "m k"]
    ) -> Float[Array, "m s nodes"]:
        """Return Σᵢⱼ Cᵢⱼ (φᵢ(x) − φᵢ(x_s)) (φⱼ(x) − φⱼ(x_s))."""

        def reading(apart: Float[Array, "k nodes"]) -> Float[Array, "m nodes"]:
            return jax.lax.map(lambda matrix: jnp.sum(apart * _matmul(matrix, apart), axis=0), matrices)

        return self._map(vectors, reading)

    def _map(self, vectors: Float[Array, "k n"], reading: Callable[[Array], Array]) -> Float[Array, "m s nodes"]:
        nodal = self.space.extend(vectors, outside=0.0).reshape(vectors.shape[0], self.space.free.size)
        readings = jax.lax.map(lambda source: reading(nodal - source[:, None]), self.coefficients(vectors))
        return jnp.moveaxis(readings, 0, 1)
