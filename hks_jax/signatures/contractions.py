"""Linear functionals of the kernel Φ C Φᵀ of a spectral function, and the derivative of its diagonal by NumPy."""

from abc import abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hks_jax.arrays import StaticArray
from hks_jax.eigen.derivative import change_of
from hks_jax.fem.pencil import Pencil
from hks_jax.fem.space import FunctionSpace
from hks_jax.linear.linear_program import HostMap
from hks_jax.linear.products import quadratic_forms
from hks_jax.linear.symmetric_pencil import SymmetricPencil
from hks_jax.signatures.filters import Filter, mixing

_matmul = partial(jnp.matmul, precision="highest")
_ON_HOST = 1 << 22
"""NumPy computes derivatives if neither the eigenvectors nor all filters' matrices have more entries than this."""
_SQUARES = 1 << 28
"""The number of squares φᵢ(x)² that are computed at once, because more of them would take the memory of the vectors."""


class Contraction(eqx.Module):
    """A linear function of the kernel Φ C Φᵀ of a matrix C (k, k), which is also linear in its own array attributes."""

    @abstractmethod
    def weighted(self, weights: Float[Array, "m k"], vectors: Float[Array, "k n"]) -> Float[Array, "m *s n"]:
        """Return the contraction of the kernel of each diagonal matrix C = diag(weights)."""

    @abstractmethod
    def mixed(
        self, matrices: Float[Array, "m k k"], vectors: Float[Array, "k n"], matters: Bool[Array, "m k"]
    ) -> Float[Array, "m *s n"]:
        """Return the contraction for each symmetric C. Cᵢⱼ is negligible unless ``matters`` marks pair i or pair j."""


class Diagonal(Contraction):
    """The diagonal (Φ C Φᵀ)(x, x) of the kernel."""

    def weighted(self, weights: Float[Array, "m k"], vectors: Float[Array, "k n"]) -> Float[Array, "m n"]:
        """Return Σᵢ cᵢ φᵢ(x)²."""

        def of_some(some: Float[Array, "k width"]) -> Float[Array, "m width"]:
            return _matmul(weights, jnp.square(some))

        k, n = vectors.shape
        if k * n <= _SQUARES:
            return of_some(vectors)
        width = max(_SQUARES // k, 1)

        def put(number: Array, values: Float[Array, "m n"]) -> Float[Array, "m n"]:
            start = jnp.minimum(number * width, n - width)
            part = of_some(jax.lax.dynamic_slice_in_dim(vectors, start, width, axis=1))
            return jax.lax.dynamic_update_slice_in_dim(values, part, start, axis=1)

        return jax.lax.fori_loop(0, -(-n // width), put, jnp.zeros((len(weights), n), vectors.dtype))

    def mixed(
        self, matrices: Float[Array, "m k k"], vectors: Float[Array, "k n"], matters: Bool[Array, "m k"]
    ) -> Float[Array, "m n"]:
        """Return Σᵢⱼ Cᵢⱼ φᵢ(x) φⱼ(x)."""
        return quadratic_forms(matrices, vectors, matters)


class _Bilinear(Contraction):
    """The sums Σᵢⱼ Cᵢⱼ aᵢ φⱼ(x) for each of s vectors a of coefficients, which are linear in the eigenfunctions."""

    @abstractmethod
    def coefficients(self, vectors: Float[Array, "k n"]) -> Float[Array, "s k"]:
        """Return the coefficients a (s, k)."""

    def weighted(self, weights: Float[Array, "m k"], vectors: Float[Array, "k n"]) -> Float[Array, "m s n"]:
        """Return Σᵢ cᵢ aᵢ φᵢ(x)."""
        return _matmul(weights[:, None, :] * self.coefficients(vectors)[None], vectors)

    def mixed(
        self, matrices: Float[Array, "m k k"], vectors: Float[Array, "k n"], matters: Bool[Array, "m k"]
    ) -> Float[Array, "m s n"]:
        """Return Σᵢⱼ Cᵢⱼ aᵢ φⱼ(x)."""
        return _matmul(_matmul(self.coefficients(vectors), matrices), vectors)


class Applied(_Bilinear):
    """The products Φ C Φᵀ w of the kernel matrix with each of s vectors w."""

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

    The differences are formed before they are squared: the terms of the expanded square would cancel at large times.
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


def host_map(
    fixed: bool,
    contraction: Contraction,
    filters: Filter,
    values: Float[Array, " k"],
    vectors: Float[Array, "k n_dof"],
    kept: Bool[Array, " k"],
    reader: Any,
) -> HostMap | None:
    """Return the derivative of a kernel's diagonal by NumPy; None for other kernels, and for large ones."""
    k, m = len(values), len(jax.tree.leaves(filters)[0])
    plain = isinstance(contraction, Diagonal) and reader is None
    if not plain or vectors.size > _ON_HOST or m * k * k > _ON_HOST:
        return None
    functions, included = np.asarray(vectors), np.asarray(kept)
    weights, of_f, of_lambda_f, matters = map(np.asarray, mixing(filters, values, kept, fixed))
    # For each filter, the matrix entry (i, j) is negligible unless i < n or j < n. The matrices are symmetric, so a sum
    # over i < n and all j is enough, if its terms with j ≥ n count twice.
    last = [int(np.max(np.flatnonzero(one), initial=-1)) + 1 for one in matters]
    times = [np.where(np.arange(k) < n, 1, 2) for n in last]

    def apply(changes: tuple[Array, Pencil]) -> np.ndarray:
        d_frame, change = np.where(included[:, None], np.asarray(changes[0]), 0), changes[1]
        images = ((matrix.to_scipy() @ functions.T).T for matrix in (change.stiffness, change.mass))
        stiffness, mass = (each @ functions.T for each in images)
        result = weights @ (2 * functions * d_frame)
        for one, (n, count) in enumerate(zip(last, times, strict=True)):
            matrix = (of_f[one] * stiffness - of_lambda_f[one] * mass)[:n] * count
            result[one] += np.sum(functions[:n] * (matrix @ functions), axis=0)
        return result

    def transpose(like: tuple[Any, Pencil], y: np.ndarray) -> tuple[np.ndarray, SymmetricPencil]:
        stiffness, mass = np.zeros((k, k), functions.dtype), np.zeros((k, k), functions.dtype)
        for one, (n, count) in enumerate(zip(last, times, strict=True)):
            outer = (functions[:n] * y[one]) @ functions.T * count
            stiffness[:n] += of_f[one, :n] * outer
            mass[:n] -= of_lambda_f[one, :n] * outer
        d_frame = np.where(included[:, None], 2 * functions * (weights.T @ y), 0)
        return d_frame, change_of(like[1], functions, stiffness @ functions, mass @ functions)

    return HostMap(apply, transpose)
