"""Inner products and preconditioners for Gauss–Newton steps, in particular for conformal factors."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.arrays import jax_array
from hks_jax.compilation import jit_quickly
from hks_jax.domain import spd
from hks_jax.domain.grid import Grid
from hks_jax.fem.assembly import assemble
from hks_jax.fem.pencil import Pencil
from hks_jax.inverse.unknowns import Nodal, Values, flat_field
from hks_jax.linear.dissection import dissect
from hks_jax.linear.multifrontal import Factorisation, factorise


class InnerProduct(eqx.Module):
    """A symmetric positive definite operator on unknowns, by default the identity."""

    def apply(self, values: Values) -> Values:
        """Return the product of the operator with the unknowns."""
        return values

    def solve(self, values: Values) -> Values:
        """Return the product of the operator's inverse with the unknowns."""
        return values

    def precondition(self, values: Values, damping: Float[Array, ""]) -> Values:
        """Return the result of `solve`, a preconditioner that ignores the damping and the data."""
        return self.solve(values)


class Smoothing(InnerProduct):
    """The inner product ⟨x, y⟩ + ℓ²⟨∇x, ∇y⟩ of each component, where ℓ is the length below which steps are smooth.

    The inner product has a mass matrix, because a boundary node has only half a cell and affects the data less.
    """

    pencil: Pencil  # the stiffness K and the lumped mass M of the flat metric
    factor: Factorisation | None  # the factorisation of K + M/ℓ²; None for ℓ = 0
    length: Float[Array, ""]  # ℓ, in coordinate units
    cell: Float[Array, ""]  # the mean mass of a node, which all masses are divided by

    def apply(self, values: Values) -> Values:
        """Return (M + ℓ²K) x for the unknowns x, divided by the mass of a cell."""
        x = values.T
        return ((self.pencil.mass.apply(x) + self.length**2 * self.pencil.stiffness.apply(x)) / self.cell).T

    def solve(self, values: Values) -> Values:
        """Return the product of the operator's inverse with the unknowns."""
        if self.factor is None:
            return values * (self.cell / self.pencil.mass.diagonal())[:, None]
        return self.factor.solve(values) * self.cell / self.length**2


def smoothing(grid: Grid, length: float, dtype: np.dtype) -> Smoothing:
    """Return the inner product of nodal values on a grid's domain."""
    pencil = assemble(flat_field(grid, dtype), mass="lumped")
    assert isinstance(pencil, Pencil)
    factor = None
    if length > 0:
        dissection = jax.tree.map(jax_array, dissect(pencil.pattern))
        factor = factorise(dissection, pencil.shifted(jnp.asarray(-1 / length**2, dtype)))
    return Smoothing(pencil, factor, jnp.asarray(length, dtype), jnp.mean(pencil.mass.diagonal()))


_TOP = 0.03
"""The size of the largest eigenvalues of JᵀJ, where J is the Jacobian of the data, for weights that add up to one."""
_POWER, _REACH = 3, 9.0
"""Of all preconditioners (1 + λt/a)ⁿ, n = 3 and a = 9 needed nearly the fewest steps on 32² and 64² nodes."""


# In the plane the metric (1 + εu) I has the Laplacian (1 − εu) Δ and the area element (1 + εu) dx. By Duhamel's formula
# this metric has the signature h₀ (1 + εv) with h₀ = 1/(4πt). For u(z) = exp(iξ·z) and x = t|ξ|²,
#
#     v = a(x) u,    a(x) = ∫₀¹ (1 + x (1 − s)²) exp(−x s (1 − s)) ds − 1.
#
# For small x, a(x) is x/6, which is the contribution tK/3 of the curvature K; for large x, a(x) is of order 1/x. So JᵀJ
# is about Σₜ wₜ a(tL)², where wₜ are the weights of the times and L is the Laplacian. Except for the first few, the
# eigenvalues of JᵀJ decrease with frequency, on grids even faster, because interpolation damps oscillations.
class ConformalInformation(eqx.Module):
    """The preconditioner B½ (1 + L/λ₁)⁻³ B½, where B is the lumped mass and L is a Laplacian of the initial metric.

    Applying the inverse takes three products with L. With the damping μ, the matrix JᵀJ + μB has eigenvalues of at
    least about μ, and λ₁ is chosen so large that the preconditioner has the same lower bound.
    """

    unknowns: Nodal  # the conformal factors at the nodes
    root: Float[Array, "n 1"]  # the square roots of the masses, relative to the mass of a cell
    weights: list[Float[Array, "..."]]  # the weights of the edges along each axis
    level: Float[Array, ""]  # the parameter λ₁ without damping
    largest: Float[Array, ""]  # a bound on the eigenvalues of L

    def precondition(self, values: Values, damping: Float[Array, ""]) -> Values:
        """Return the product of the operator's inverse with the unknowns, for the damping μ."""
        fall = jnp.maximum(_TOP / damping, 1.01) ** (1 / _POWER)
        level = jnp.maximum(self.level, self.largest / (fall - 1))
        y = values / self.root
        return jax.lax.fori_loop(0, _POWER, lambda _, y: y + self._laplacian(y) / level, y) / self.root

    def _laplacian(self, y: Values) -> Values:
        slopes, back = jax.vjp(self.unknowns.slopes, y / self.root)
        return back([weight[None] * slope for weight, slope in zip(self.weights, slopes, strict=True)])[0] / self.root


@jit_quickly(eqx.filter_jit)
def conformal_information(unknowns: Nodal, mass: InnerProduct, times: Float[Array, " n_times"]) -> ConformalInformation:
    """Return the preconditioner for signatures at these times; `mass` is the inner product with ℓ = 0."""
    grid, nodes = unknowns.init.grid, unknowns.nodes.value
    relative = mass.apply(unknowns.start() + 1)
    at_nodes = jnp.zeros(grid.size, relative.dtype).at[nodes].set(relative[:, 0]).reshape(grid.shape)
    inverse = spd.inverse(unknowns.init.domain_tensors)
    weights, rows = [], jnp.zeros_like(at_nodes)
    for axis in range(grid.dimension):
        size, along = (jnp.moveaxis(x, axis, 0) for x in (at_nodes, inverse[..., axis, axis]))
        weight = jnp.maximum(size[1:], size[:-1]) * (along[1:] + along[:-1]) / 2
        weight = jnp.where((size[1:] > 0) & (size[:-1] > 0), weight, 0)
        weights.append(jnp.moveaxis(weight, 0, axis))
        around = jnp.pad(weight, [(1, 1), *[(0, 0)] * (grid.dimension - 1)]) / grid.spacing[axis] ** 2
        rows += jnp.moveaxis(around[1:] + around[:-1], 0, axis)
    largest = 2 * jnp.max(rows.ravel()[nodes] / relative[:, 0])
    return ConformalInformation(unknowns, jnp.sqrt(relative), weights, _REACH / jnp.min(times), largest)
