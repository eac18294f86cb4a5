"""The inner product in which steps of a fit are small: the identity, or one that prefers smooth steps."""

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.domain.grid import Grid
from hks_jax.domain.tensor_field import TensorField
from hks_jax.fem.assembly import assemble
from hks_jax.fem.pencil import Pencil
from hks_jax.fem.space import GridSpace
from hks_jax.inverse.unknowns import Values
from hks_jax.linear.dissection import dissect
from hks_jax.linear.multifrontal import Factorisation, factorise


class Preconditioner(eqx.Module):
    """What resembles JᵀJ + μB, up to a factor: symmetric, positive definite, and with an inverse."""

    @abstractmethod
    def precondition(self, values: Values, damping: Float[Array, ""]) -> Values:
        """Return the product of the inverse with the unknowns, for damping μ."""


class InnerProduct(Preconditioner):
    """A symmetric positive definite operator on unknowns."""

    @abstractmethod
    def apply(self, values: Values) -> Values:
        """Return its product with the unknowns."""

    @abstractmethod
    def solve(self, values: Values) -> Values:
        """Return the product of its inverse with the unknowns."""

    def precondition(self, values: Values, damping: Float[Array, ""]) -> Values:
        """Return `solve`: of JᵀJ nothing is known."""
        return self.solve(values)


class Euclidean(InnerProduct):
    """The identity."""

    def apply(self, values: Values) -> Values:
        """Return the values."""
        return values

    def solve(self, values: Values) -> Values:
        """Return the values."""
        return values


class Smoothing(InnerProduct):
    """⟨x, y⟩ + ℓ²⟨∇x, ∇y⟩ over the domain, for each component: ℓ is the length below which steps are smooth.

    With the mass and not the identity, because a node at the side stands for half a cell: where the same change of the
    field is a smaller one of the data.

    Attributes:
        pencil: stiffness and lumped mass of the flat metric.
        factor: the factorisation of K + M/ℓ²; None for ℓ = 0.
        length: ℓ, in coordinate units.
        cell: the mean of the masses, by which they are divided.
    """

    pencil: Pencil
    factor: Factorisation | None
    length: Float[Array, ""]
    cell: Float[Array, ""]

    def apply(self, values: Values) -> Values:
        """Return (M + ℓ²K) x over the cell's mass."""
        x = values.T
        return ((self.pencil.mass.apply(x) + self.length**2 * self.pencil.stiffness.apply(x)) / self.cell).T

    def solve(self, values: Values) -> Values:
        """Return the inverse's product."""
        if self.factor is None:
            return values * (self.cell / self.pencil.mass.diagonal())[:, None]
        return (self.factor.solve(values.T) * self.cell / self.length**2).T


def smoothing(grid: Grid, length: float, dtype: np.dtype) -> Smoothing:
    """Return the inner product for numbers at the nodes of a grid's domain."""
    d = grid.dimension
    flat = TensorField(grid, np.broadcast_to(np.eye(d, dtype=dtype), (*grid.shape, d, d)))
    pencil = assemble(flat, mass="lumped")
    assert isinstance(pencil, Pencil)
    assert isinstance(pencil.space, GridSpace)
    factor = None
    if length > 0:
        dissection = jax.tree.map(jnp.asarray, dissect(pencil.pattern))
        factor = factorise(dissection, pencil.shifted(jnp.asarray(-1 / length**2, dtype)))
    return Smoothing(pencil, factor, jnp.asarray(length, dtype), jnp.mean(pencil.mass.diagonal()))
