"""The unknowns of a fit: arrays of parameters, and the field that they stand for."""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from hks_jax.arrays import StaticArray
from hks_jax.domain.tensor_field import TensorField
from hks_jax.inverse.parametrisation import Parametrisation

Values = Float[Array, "..."]


class Unknowns(eqx.Module):
    """What a fit varies."""

    @abstractmethod
    def start(self) -> Values:
        """Return the values at the initial field."""

    @abstractmethod
    def field(self, values: Values) -> TensorField:
        """Return the field that the values stand for."""

    def slopes(self, values: Values) -> list[Float[Array, "c *edges"]]:
        """Return the values' slopes along the grid's edges, axis by axis; zero where an end is outside the domain."""
        raise ValueError("regularisers: parameters of a function have no neighbours; use Prior or LogDeterminant")


class Nodal(Unknowns):
    """A few numbers at each node of the domain."""

    parametrisation: Parametrisation  # what they mean
    init: TensorField  # the initial field, which stays as it is outside the domain
    nodes: StaticArray = eqx.field(static=True)  # the flat indices of the domain's nodes

    @property
    def _base(self) -> Float[Array, "n d d"]:
        d = self.init.grid.dimension
        return self.init.domain_tensors.reshape(-1, d, d)[self.nodes.value]

    def start(self) -> Values:
        """Return the parameters of the initial field."""
        return self.parametrisation.start(self._base)

    def field(self, values: Values) -> TensorField:
        """Return the field with these parameters."""
        grid = self.init.grid
        all_tensors = self.init.domain_tensors.reshape(-1, grid.dimension, grid.dimension)
        moved = self.parametrisation.tensors(values, self._base)
        full = all_tensors.at[self.nodes.value].set(moved)
        return TensorField(grid, full.reshape(self.init.domain_tensors.shape), self.init.interpolation)

    def slopes(self, values: Values) -> list[Float[Array, "c *edges"]]:
        """Return the parameters' slopes along the grid's edges, axis by axis; zero where an end is outside."""
        grid = self.init.grid
        domain = np.zeros(grid.size, dtype=bool)
        domain[self.nodes.value] = True
        fields = jnp.zeros((values.shape[1], grid.size), values.dtype).at[:, self.nodes.value].set(values.T)
        fields, differences = fields.reshape(-1, *grid.shape), []
        for axis in range(grid.dimension):
            inside = np.moveaxis(domain.reshape(grid.shape), axis, 0)
            both = np.moveaxis(inside[1:] & inside[:-1], 0, axis)
            differences.append(jnp.where(both, jnp.diff(fields, axis=axis + 1) / grid.spacing[axis], 0))
        return differences


class Free(Unknowns):
    """The parameters of a function of the user's."""

    function: Callable[[Any], Any] = eqx.field(static=True)  # maps them to a field, or to tensors on its grid
    parameters: Any  # where to start, any pytree of floating point arrays
    init: TensorField  # the initial field, for its grid and interpolation

    def start(self) -> Values:
        """Return the initial parameters, flat."""
        return ravel_pytree(jax.tree.map(jnp.asarray, self.parameters))[0]

    def field(self, values: Values) -> TensorField:
        """Return the field with these parameters."""
        tensors = self.function(ravel_pytree(jax.tree.map(jnp.asarray, self.parameters))[1](values))
        if isinstance(tensors, TensorField):
            return tensors
        return TensorField(self.init.grid, tensors, self.init.interpolation)


def nodes_of(domain: np.ndarray) -> StaticArray:
    """Return the flat indices of the nodes of a domain."""
    return StaticArray(np.flatnonzero(domain))
