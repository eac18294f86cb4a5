"""Parametrisations: which metrics a fit searches among, and by which numbers at each node.

Every one of them gives symmetric positive definite tensors for any numbers.
"""

from abc import abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.domain import spd
from hks_jax.linear.dense_eigh import differentiable_eigh

Tensors = Float[Array, "n d d"]
Parameters = Float[Array, "n c"]


class Parametrisation(eqx.Module):
    """Maps c numbers at each node to a tensor, given the tensor of the initial field there.

    Attributes:
        name: what `fit_metric` calls it.
        smooth: whether the data determine high frequencies so weakly that steps should be smooth.
    """

    name: ClassVar[str]
    smooth: ClassVar[bool] = True

    @abstractmethod
    def start(self, base: Tensors) -> Parameters:
        """Return the parameters of the initial tensors."""

    @abstractmethod
    def tensors(self, parameters: Parameters, base: Tensors) -> Tensors:
        """Return the tensors that the parameters stand for."""


class LogEuclidean(Parametrisation):
    """T = exp S: the matrix logarithm, in coordinates in which the Frobenius norm is the Euclidean one."""

    name: ClassVar[str] = "log-euclidean"

    def start(self, base: Tensors) -> Parameters:
        """Return log T₀."""
        return to_coordinates(spd.log(base))

    def tensors(self, parameters: Parameters, base: Tensors) -> Tensors:
        """Return exp S."""
        return spd.exp(from_coordinates(parameters, base.shape[-1]))


class Cholesky(Parametrisation):
    """T = LLᵀ, L lower triangular: the logarithms of its diagonal, then what is below it."""

    name: ClassVar[str] = "cholesky"

    def start(self, base: Tensors) -> Parameters:
        """Return the Cholesky factor of T₀."""
        factor, d = spd.cholesky(base), base.shape[-1]
        below = [factor[:, i, j] for i in range(d) for j in range(i)]
        return jnp.stack([*(jnp.log(factor[:, i, i]) for i in range(d)), *below], axis=-1)

    def tensors(self, parameters: Parameters, base: Tensors) -> Tensors:
        """Return LLᵀ."""
        d = base.shape[-1]
        rows, columns = np.tril_indices(d, -1)
        factor = jnp.zeros_like(base).at[:, rows, columns].set(parameters[:, d:])
        factor = factor.at[:, np.arange(d), np.arange(d)].set(jnp.exp(parameters[:, :d]))
        return jnp.matmul(factor, jnp.swapaxes(factor, 1, 2), precision="highest")


class Conformal(Parametrisation):
    """T = e^u T₀: one number, angles stay."""

    name: ClassVar[str] = "conformal"
    smooth: ClassVar[bool] = False

    def start(self, base: Tensors) -> Parameters:
        """Return u = 0."""
        return jnp.zeros((len(base), 1), base.dtype)

    def tensors(self, parameters: Parameters, base: Tensors) -> Tensors:
        """Return e^u T₀."""
        return jnp.exp(parameters)[:, :, None] * base


class Eigenvalues(Parametrisation):
    """T = V diag(e^uᵢ λᵢ) Vᵀ: the eigenvectors of T₀ stay."""

    name: ClassVar[str] = "eigenvalues"

    def start(self, base: Tensors) -> Parameters:
        """Return u = 0."""
        return jnp.zeros(base.shape[:2], base.dtype)

    def tensors(self, parameters: Parameters, base: Tensors) -> Tensors:
        """Return V diag(e^uᵢ λᵢ) Vᵀ."""
        values, vectors = jax.vmap(partial(differentiable_eigh, None))(base)
        return jnp.einsum("nia,na,nja->nij", vectors, jnp.exp(parameters) * values, vectors, precision="highest")


class Rotation(Parametrisation):
    """T = R T₀ Rᵀ: the eigenvalues stay. In 2D the angle of R, in 3D its rotation vector, in radians."""

    name: ClassVar[str] = "rotation"

    def start(self, base: Tensors) -> Parameters:
        """Return the angle 0."""
        return jnp.zeros((len(base), 1 if base.shape[-1] == 2 else 3), base.dtype)

    def tensors(self, parameters: Parameters, base: Tensors) -> Tensors:
        """Return R T₀ Rᵀ."""
        rotation = _rotation_2d(parameters[:, 0]) if base.shape[-1] == 2 else _rotation_3d(parameters)
        return jnp.einsum("nia,nab,njb->nij", rotation, base, rotation, precision="highest")


PARAMETRISATIONS: dict[str, Callable[[], Parametrisation]] = {
    each.name: each for each in (LogEuclidean, Cholesky, Conformal, Eigenvalues, Rotation)
}


def to_coordinates(symmetric: Tensors) -> Parameters:
    """Return the diagonal, then √2 times what is below it: the Euclidean norm is the Frobenius norm."""
    d = symmetric.shape[-1]
    rows, columns = np.tril_indices(d, -1)
    diagonal = jnp.diagonal(symmetric, axis1=1, axis2=2)
    return jnp.concatenate([diagonal, np.sqrt(2) * symmetric[:, rows, columns]], axis=1)


def from_coordinates(coordinates: Parameters, d: int) -> Tensors:
    """Undo `to_coordinates`."""
    rows, columns = np.tril_indices(d, -1)
    below = coordinates[:, d:] / np.sqrt(2)
    matrix = jnp.zeros((len(coordinates), d, d), coordinates.dtype)
    matrix = matrix.at[:, np.arange(d), np.arange(d)].set(coordinates[:, :d])
    return matrix.at[:, rows, columns].set(below).at[:, columns, rows].set(below)


def _rotation_2d(angle: Float[Array, " n"]) -> Tensors:
    c, s = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([jnp.stack([c, -s], axis=-1), jnp.stack([s, c], axis=-1)], axis=-2)


def _rotation_3d(vector: Float[Array, "n 3"]) -> Tensors:
    """Rodrigues' formula, in functions of the squared angle that are smooth at zero."""
    square = jnp.sum(vector**2, axis=1)
    small = square < 1e-4
    angle = jnp.sqrt(jnp.where(small, 1, square))
    sinc = jnp.where(small, 1 - square / 6 + square**2 / 120, jnp.sin(angle) / angle)
    versine = jnp.where(small, 0.5 - square / 24 + square**2 / 720, (1 - jnp.cos(angle)) / angle**2)
    x, y, z = vector.T
    o = jnp.zeros_like(x)
    cross = jnp.stack([jnp.stack(row, axis=-1) for row in ((o, -z, y), (z, o, -x), (-y, x, o))], axis=-2)
    square_of_cross = jnp.matmul(cross, cross, precision="highest")
    return jnp.eye(3, dtype=vector.dtype) + sinc[:, None, None] * cross + versine[:, None, None] * square_of_cross


def choose_parametrisation(given: Any) -> Parametrisation:
    """Return the parametrisation that a name stands for."""
    if isinstance(given, Parametrisation):
        return given
    if isinstance(given, str) and given in PARAMETRISATIONS:
        return PARAMETRISATIONS[given]()
    names = ", ".join(repr(name) for name in PARAMETRISATIONS)
    raise ValueError(
        f"parametrisation: got {given!r}; expected {names}, a Parametrisation, or a function of `parameters` to tensors"
    )
