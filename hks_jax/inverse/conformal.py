"""Inner products and preconditioners for Gauss–Newton steps, in particular for conformal factors."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.arrays import jax_array
from hks_jax.compilation import jit_quickly
from hks_jax.domain import spd
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
    """The inner product ⟨x, y⟩ + ℓ²⟨∇x, ∇y⟩ of nodal parameters x and y, which makes steps smooth below the length ℓ.

    The mass matrix gives boundary nodes less weight, because they have only half a cell and affect the data less.
    """

    pencil: Pencil  # the stiffness K and the lumped mass M of the flat metric
    factor: Factorisation | None  # the factorisation of the matrix K + M/ℓ²; None for ℓ = 0
    length: Float[Array, ""]  # the length ℓ, in coordinate units
    cell: Float[Array, ""]  # the mean of the nodal masses, by which all masses are divided

    def apply(self, values: Values) -> Values:
        """Return (M + ℓ²K) x for the unknowns x, divided by the mean nodal mass."""
        x = values.T
        return ((self.pencil.mass.apply(x) + self.length**2 * self.pencil.stiffness.apply(x)) / self.cell).T

    def solve(self, values: Values) -> Values:
        """Return the product of the operator's inverse with the unknowns."""
        if self.factor is None:
            return values * (self.cell / self.pencil.mass.diagonal())[:, None]
        return self.factor.solve(values) * self.cell / self.length**2


def smoothing(unknowns: Nodal, length: float) -> Smoothing:
    """Return the inner product of nodal values on the domain of the unknowns."""
    grid, dtype = unknowns.init.grid, unknowns.init.domain_tensors.dtype
    seams = (np.moveaxis(edges, axis, 0)[-1].any() for axis, edges in enumerate(unknowns.edges))
    pencil = assemble(flat_field(grid, dtype), tuple("periodic" if seam else "neumann" for seam in seams), "lumped")
    assert isinstance(pencil, Pencil)
    factor = None
    if length > 0:
        dissection = jax.tree.map(jax_array, dissect(pencil.pattern))
        factor = factorise(dissection, pencil.shifted(jnp.asarray(-1 / length**2, dtype)))
    return Smoothing(pencil, factor, jnp.asarray(length, dtype), jnp.mean(pencil.mass.diagonal()))


_TOP = 0.03
"""The size of the largest eigenvalues of JᵀJ, where J is the Jacobian of the data, for weights that add up to one."""
_POWER, _REACH = 3, 9.0
"""The exponent n and the divisor a of the preconditioner B½ (1 + tL/a)⁻ⁿ B½, where t is the smallest time. On 32² and
64² nodes, the exponent 3 and the divisor 9 took nearly the fewest conjugate gradient steps."""


# To first order in ε, the metric (1 + εu) I of the plane has the Laplacian (1 − εu) Δ and the area element (1 + εu) dx.
# By Duhamel's formula, the metric (1 + εu) I has the HKS (1 + εv)/(4πt), with a relative change εv. If the perturbation
# u(z) = exp(iξ·z) is a wave with the wave vector ξ, the change v at the time t = x/|ξ|² is
#
#     v = a(x) u,    a(x) = ∫₀¹ (1 + x (1 − s)²) exp(−x s (1 − s)) ds − 1.
#
# For small x, the factor a(x) is about x/6, which is the term tK/3 of the HKS for the curvature K; for large x, a(x) is
# of order 1/x. So the matrix JᵀJ for the data's Jacobian J is about Σₜ wₜ a(tL)², where wₜ is the weight of the time t
# and L is the Laplacian. Except for the first few, the eigenvalues of JᵀJ decrease with frequency, and on grids they
# decrease even faster, because interpolation damps oscillations.
class ConformalInformation(eqx.Module):
    """The preconditioner B½ (1 + L/λ₁)⁻³ B½, where B is the lumped mass and L is a Laplacian of the initial metric.

    Applying the preconditioner's inverse takes three products with L. For the data's Jacobian J and the damping μ, the
    matrix JᵀJ + μB has eigenvalues of at least about μ; a large λ₁ gives the preconditioner the same lower bound.
    """

    unknowns: Nodal  # the conformal factors at the nodes
    root: Float[Array, "n 1"]  # the square roots of the nodal masses, relative to their mean
    weights: Float[Array, "d *shape"]  # the weights of the edges from each node to the next along each axis
    level: Float[Array, ""]  # the parameter λ₁ without damping
    largest: Float[Array, ""]  # an upper bound on the eigenvalues of the Laplacian L

    def precondition(self, values: Values, damping: Float[Array, ""]) -> Values:
        """Return the product of the preconditioner's inverse with the unknowns, for the damping μ."""
        fall = jnp.maximum(_TOP / damping, 1.01) ** (1 / _POWER)
        level = jnp.maximum(self.level, self.largest / (fall - 1))
        y = values / self.root
        return jax.lax.fori_loop(0, _POWER, lambda _, y: y + self._laplacian(y) / level, y) / self.root

    def _laplacian(self, y: Values) -> Values:
        slopes, back = jax.vjp(self.unknowns.slopes, y / self.root)
        return back(self.weights[:, None] * slopes)[0] / self.root


@jit_quickly(eqx.filter_jit)
def conformal_information(unknowns: Nodal, mass: InnerProduct, times: Float[Array, " n_times"]) -> ConformalInformation:
    """Return the preconditioner for fits to the HKS at the given times; `mass` is a `Smoothing` of length ℓ = 0."""
    grid, nodes = unknowns.init.grid, unknowns.nodes.value
    relative = mass.apply(unknowns.start() + 1)
    at_nodes = jnp.zeros(grid.size, relative.dtype).at[nodes].set(relative[:, 0]).reshape(grid.shape)
    inverse = spd.inverse(unknowns.init.domain_tensors)
    weights, rows = [], jnp.zeros_like(at_nodes)
    for axis, edges in enumerate(unknowns.edges):
        along = inverse[..., axis, axis]
        size, mean = jnp.maximum(at_nodes, jnp.roll(at_nodes, -1, axis)), (along + jnp.roll(along, -1, axis)) / 2
        weights.append(jnp.where(edges, size * mean, 0))
        rows += (weights[-1] + jnp.roll(weights[-1], 1, axis)) / grid.spacing[axis] ** 2
    largest = 2 * jnp.max(rows.ravel()[nodes] / relative[:, 0])
    return ConformalInformation(unknowns, jnp.sqrt(relative), jnp.stack(weights), _REACH / jnp.min(times), largest)
