"""The unknowns of a fit: the set of metrics and their parameters."""

from abc import abstractmethod
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float

from hks_jax.arrays import StaticArray
from hks_jax.checks import real_array, require_real
from hks_jax.domain import spd
from hks_jax.domain.grid import Grid
from hks_jax.domain.tensor_field import TensorField
from hks_jax.fem.space import GridSpace

Values = Float[Array, "..."]
Tensors = Float[Array, "n d d"]
Parameters = Float[Array, "n c"]


def named(argument: str, given: Any, table: Mapping[str, Any], others: str) -> Any:
    """Return the entry of a table with a given name, or raise ValueError that lists all names and `others`."""
    if isinstance(given, str) and given in table:
        return table[given]
    raise ValueError(f"{argument}: got {given!r}; expected {', '.join(map(repr, table))}, {others}")


def flat_field(grid: Grid, dtype: Any = float) -> TensorField:
    """Return the flat metric, which is the identity at all nodes."""
    d = grid.dimension
    return TensorField(grid, np.broadcast_to(np.eye(d, dtype=dtype), (*grid.shape, d, d)))


class Parametrisation(eqx.Module):
    """A map from a few parameters and the initial tensor at each node to a tensor.

    Attributes:
        start: maps the initial tensors (n, d, d) to their parameters (n, c).
        tensors: maps parameters (n, c) and the initial tensors to tensors that are always symmetric positive definite.
        smooth: whether to smooth the solver's steps, because the data hardly determine high frequencies.
    """

    start: Callable[[Tensors], Parameters] = eqx.field(static=True)
    tensors: Callable[[Parameters, Tensors], Tensors] = eqx.field(static=True)
    smooth: bool = eqx.field(static=True, default=True)


def _logarithm(base: Tensors) -> Parameters:
    """Return the diagonal of log T and √2 times the entries below the diagonal, a vector with the norm of log T."""
    logarithm = spd.log(base)
    rows, columns = np.tril_indices(base.shape[-1], -1)
    diagonal = jnp.diagonal(logarithm, axis1=1, axis2=2)
    return jnp.concatenate([diagonal, np.sqrt(2) * logarithm[:, rows, columns]], axis=1)


def _exponential(parameters: Parameters, base: Tensors) -> Tensors:
    d = base.shape[-1]
    rows, columns = np.tril_indices(d, -1)
    below = parameters[:, d:] / np.sqrt(2)
    matrix = jnp.zeros_like(base).at[:, np.arange(d), np.arange(d)].set(parameters[:, :d])
    return spd.exp(matrix.at[:, rows, columns].set(below).at[:, columns, rows].set(below))


def _cholesky(base: Tensors) -> Parameters:
    factor, d = spd.cholesky(base), base.shape[-1]
    rows, columns = np.tril_indices(d, -1)
    diagonal = jnp.diagonal(factor, axis1=1, axis2=2)
    return jnp.concatenate([jnp.log(diagonal), factor[:, rows, columns]], axis=1)


def _from_cholesky(parameters: Parameters, base: Tensors) -> Tensors:
    d = base.shape[-1]
    rows, columns = np.tril_indices(d, -1)
    factor = jnp.zeros_like(base).at[:, rows, columns].set(parameters[:, d:])
    factor = factor.at[:, np.arange(d), np.arange(d)].set(jnp.exp(parameters[:, :d]))
    return jnp.matmul(factor, jnp.swapaxes(factor, 1, 2), precision="highest")


def _scaled(parameters: Parameters, base: Tensors) -> Tensors:
    return jnp.exp(parameters)[:, :, None] * base


def _stretched(parameters: Parameters, base: Tensors) -> Tensors:
    values, vectors = spd.eigh(base)
    return jnp.einsum("nia,na,nja->nij", vectors, jnp.exp(parameters) * values, vectors, precision="highest")


def _turned(parameters: Parameters, base: Tensors) -> Tensors:
    d = base.shape[-1]
    vectors = parameters if d == 3 else jnp.pad(parameters, ((0, 0), (2, 0)))  # perpendicular to the plane
    rotation = _rotation(vectors)[:, :d, :d]
    return jnp.einsum("nia,nab,njb->nij", rotation, base, rotation, precision="highest")


def _rotation(vector: Float[Array, "n 3"]) -> Tensors:
    """Return rotations by Rodrigues' formula with functions of the squared angle, which are smooth at zero."""
    square = jnp.sum(vector**2, axis=1)
    small = square < 1e-4
    angle = jnp.sqrt(jnp.where(small, 1, square))
    sinc = jnp.where(small, 1 - square / 6 + square**2 / 120, jnp.sin(angle) / angle)
    versine = jnp.where(small, 0.5 - square / 24 + square**2 / 720, (1 - jnp.cos(angle)) / angle**2)
    x, y, z = vector.T
    o = jnp.zeros_like(x)
    cross = jnp.stack([jnp.stack(row, axis=-1) for row in ((o, -z, y), (z, o, -x), (-y, x, o))], axis=-2)
    square_of_cross = jnp.matmul(cross, cross, precision="highest")
    return jnp.eye(3, dtype=vector.dtype)[None] + sinc[:, None, None] * cross + versine[:, None, None] * square_of_cross


def _zeros(counts: tuple[int, int], base: Tensors) -> Parameters:
    return jnp.zeros((len(base), counts[base.shape[-1] - 2]), base.dtype)


PARAMETRISATIONS = {
    # The initial tensor is T₀ = V diag(λᵢ) Vᵀ, with eigenvectors in V and eigenvalues λᵢ.
    "log-euclidean": Parametrisation(_logarithm, _exponential),  # T = exp S for a symmetric matrix S
    "cholesky": Parametrisation(_cholesky, _from_cholesky),  # T = LLᵀ for a lower triangular matrix L
    "conformal": Parametrisation(partial(_zeros, (1, 1)), _scaled, smooth=False),  # T = e^u T₀ for a number u
    "eigenvalues": Parametrisation(partial(_zeros, (2, 3)), _stretched),  # T = V diag(e^uᵢ λᵢ) Vᵀ for numbers uᵢ
    "rotation": Parametrisation(partial(_zeros, (1, 3)), _turned),  # T = R T₀ Rᵀ for a rotation R
}


class Unknowns(eqx.Module):
    """The parameters that a fit varies."""

    @abstractmethod
    def start(self) -> Values:
        """Return the parameters of the initial field."""

    @abstractmethod
    def field(self, values: Values) -> TensorField:
        """Return the field with given parameters."""

    def slopes(self, values: Values) -> Float[Array, "d c *shape"]:
        """Return the slopes of the parameters from each node to the next along each axis, and 0 outside the domain."""
        raise ValueError(
            "regularisers: got a slope penalty, but the unknowns are parameters of a function and have no slopes on "
            "the grid; expected Prior or LogDeterminant"
        )


class Nodal(Unknowns):
    """Parameters at each node of the domain."""

    parametrisation: Parametrisation  # the map from parameters to tensors
    init: TensorField  # the initial field, which does not change outside the domain
    # The flat indices of the domain's nodes; the constructor takes the domain, bool (*shape).
    nodes: Any = eqx.field(static=True, converter=lambda domain: StaticArray(np.flatnonzero(domain)))
    periodic: tuple[bool, ...] = eqx.field(static=True)  # for each axis, whether its last nodes adjoin the first ones

    @property
    def _base(self) -> Float[Array, "n d d"]:
        d = self.init.grid.dimension
        return self.init.domain_tensors.reshape(-1, d, d)[self.nodes.value]

    def start(self) -> Values:
        """Return the parameters of the initial field."""
        return self.parametrisation.start(self._base)

    def field(self, values: Values) -> TensorField:
        """Return the field with given parameters."""
        grid = self.init.grid
        all_tensors = self.init.domain_tensors.reshape(-1, grid.dimension, grid.dimension)
        moved = self.parametrisation.tensors(values, self._base)
        full = all_tensors.at[self.nodes.value].set(moved)
        return self.init.with_tensors(full.reshape(self.init.domain_tensors.shape))

    @property
    def edges(self) -> Bool[np.ndarray, "d *shape"]:
        """For each axis, whether each node and the next node along the axis are in the domain."""
        grid = self.init.grid
        domain = np.zeros(grid.size, bool)
        domain[self.nodes.value] = True
        domain = domain.reshape(grid.shape)
        both = np.stack([domain & np.roll(domain, -1, axis) for axis in range(grid.dimension)])
        for axis, wraps in enumerate(self.periodic):
            if not wraps:
                np.moveaxis(both[axis], axis, 0)[-1] = False
        return both

    def slopes(self, values: Values) -> Float[Array, "d c *shape"]:
        """Return the slopes of the parameters from each node to the next along each axis, and 0 outside the domain."""
        grid = self.init.grid
        fields = jnp.zeros((values.shape[1], grid.size), values.dtype).at[:, self.nodes.value].set(values.T)
        fields = fields.reshape(-1, *grid.shape)
        differences = [(jnp.roll(fields, -1, axis + 1) - fields) / spacing for axis, spacing in enumerate(grid.spacing)]
        return jnp.where(self.edges[:, None], jnp.stack(differences), 0)


class Free(Unknowns):
    """Parameters of a function that serves as the parametrisation of `hks_jax.fit_metric`.

    Attributes:
        function: maps the parameters to a `TensorField`, or to tensors on the grid of the initial field.
        parameters: the initial parameters, any pytree of floating point arrays.
        init: the initial field, whose grid and interpolation apply if `function` returns tensors; `fit_metric` sets it.

    Examples:
        >>> scaled = hj.inverse.Free(lambda s: s * field.tensors, jnp.array(1.1))
        >>> fit = hj.fit_metric(field, hj.hks(pairs, [0.2, 0.5]), [0.2, 0.5], scaled)
        >>> print(fit.values.round(3))
        [1.]
    """

    function: Callable[[Any], Any] = eqx.field(static=True)
    parameters: Any
    init: TensorField | None = None

    def __check_init__(self) -> None:
        """Check the parameters."""
        require_real("parameters", self.parameters)

    def start(self) -> Values:
        """Return the flattened initial parameters."""
        return self._ravelled()[0]

    def _ravelled(self) -> tuple[Values, Callable[[Values], Any]]:
        return ravel_pytree(jax.tree.map(lambda given: real_array("parameters", given), self.parameters))

    def field(self, values: Values) -> TensorField:
        """Return the field with given parameters."""
        tensors = self.function(self._ravelled()[1](values))
        if isinstance(tensors, TensorField):
            return tensors
        assert self.init is not None
        return self.init.with_tensors(tensors)


def unknowns_for(parametrisation: str | Parametrisation | Free, init: TensorField, space: GridSpace) -> Unknowns:
    """Return the unknowns of a fit that starts from a field, at the nodes of the space."""
    if isinstance(parametrisation, Free):
        return Free(parametrisation.function, parametrisation.parameters, init)
    chosen, others = parametrisation, "a Parametrisation, or Free(function, parameters)"
    if not isinstance(chosen, Parametrisation):
        chosen = named("parametrisation", chosen, PARAMETRISATIONS, others)
    return Nodal(chosen, init, space.domain, space.periodic)
