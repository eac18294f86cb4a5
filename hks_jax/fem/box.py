"""The pencil of a grid on the box around its domain, where similar masks share compiled code."""

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hks_jax.fem.pencil import Pencil
from hks_jax.fem.space import FunctionSpace, GridSpace
from hks_jax.fem.stencil import StencilOperator, coefficients_of
from hks_jax.linear.operators import DiagonalOperator, Operator
from hks_jax.linear.symmetric_pencil import NullSpace
from hks_jax.traced import is_traced

_FILLED = {2: 0.45, 3: 0.6}
"""The least fraction of free nodes, for each dimension, at which all nodes of the box are unknowns. With half of the
nodes free in 2D, computations on all nodes take 1.4 to 1.9 times as long as on the free nodes, so that ten calls lose
the time that the shared compilation saves. In 3D the cost of a factorisation grows faster with the number of nodes."""


class Box(NamedTuple):
    """A pencil with the same lowest eigenpairs as a given one, on the box around its domain.

    Attributes:
        pencil: the pencil.
        unknowns: the space of the given pencil's unknowns, on the nodes of the box.
    """

    pencil: Pencil
    unknowns: FunctionSpace

    def into(self, rows: Float[Array, "m n_dof"]) -> Float[Array, "m n_box"]:
        """Return functions of the given unknowns as those of the box."""
        return self.unknowns.transfer(rows, self.pencil.space)

    def out_of(self, rows: Float[Array, "m n_box"]) -> Float[Array, "m n_dof"]:
        """Return functions of the box as those of the given unknowns."""
        return self.pencil.space.transfer(rows, self.unknowns)


def in_box(pencil: Pencil, k: int) -> Box:
    """Return the box whose pencil has the same k lowest eigenpairs, for solvers that compute on all of its nodes."""
    inner = cropped(pencil)
    return Box(_on_all_nodes(inner, k), inner.space)


def cropped(pencil: Pencil) -> Pencil:
    """Return the pencil on the part of its grid around the domain, with the same unknowns in the same order.

    Along periodic axes the grid stays whole. The pencil is returned unchanged if cropping would save few nodes, or if
    it is not that of functions on a grid.
    """
    if not isinstance(pencil.space, GridSpace):
        return pencil
    box, space = pencil.space.around
    if space == pencil.space:
        return pencil

    def part(matrix: Any) -> Any:
        every = (slice(None), *box)
        return StencilOperator(matrix.coefficients[every], space) if isinstance(matrix, StencilOperator) else matrix

    parts = {"stiffness": part(pencil.stiffness), "mass": part(pencil.mass), "space": space}
    return replace(pencil, **parts, metric=None, density=None, source=None)


def _on_all_nodes(pencil: Pencil, k: int) -> Pencil:
    """Return a pencil with the same k lowest eigenpairs whose unknowns are all nodes of the grid, or the given pencil.

    Each node i that is not free gets a separate equation: in row i of both matrices, only the diagonal entries Mᵢᵢ = m
    and Kᵢᵢ = σm are not zero. The eigenvalue σ of this equation is above the lowest quarter of the spectrum; the other
    eigenvectors vanish at node i. The given pencil is returned if few nodes are free, if k exceeds a quarter of their
    number, or if the pencil is traced, as `jax.jit` compiles code for each mask anyway.
    """
    space = pencil.space
    if 4 * k > pencil.size or is_traced(jax.lax.stop_gradient(pencil.stiffness)) or not isinstance(space, GridSpace):
        return pencil
    if not _FILLED[space.dimension] * space.free.size <= space.n_dof < space.free.size:
        return pencil
    whole, nulls, sums = space.whole, pencil.null_space, pencil.row_sums
    if nulls is not None:
        vectors = space.extend(nulls.vectors, outside=0.0)
        nulls = NullSpace(vectors.reshape(len(vectors), whole.n_dof), nulls.fixed)
    if sums is not None:  # infinite in the separate equations, so that `Pencil.read` adds nothing to their unknowns
        sums = jnp.where(space.free, space.extend(sums, outside=0.0), jnp.inf).ravel()
    of_stiffness, of_mass = (coefficients_of(each, space) for each in (pencil.stiffness, pencil.mass))
    of_stiffness, of_mass = _with_others(of_stiffness, of_mass, space.free)
    diagonal = isinstance(pencil.mass, DiagonalOperator)
    mass: Operator = DiagonalOperator(of_mass.ravel()) if diagonal else StencilOperator(of_mass, whole)
    stiffness = StencilOperator(of_stiffness, whole)
    return replace(pencil, stiffness=stiffness, mass=mass, space=whole, null_space=nulls, row_sums=sums)


# Let s be the largest quotient Kᵢᵢ/Mᵢᵢ of the free nodes, a Rayleigh quotient, or for a lumped mass Gershgorin's upper
# bound of the spectrum. The eigenvalue σ of the separate equations must exceed the lowest quarter of the spectrum, and
# should not exceed the largest eigenvalue by much. For the Laplacian, a consistent mass and the node spacing h, s is
# 6/h² in 2D and 9/h² in 3D, and the lowest quarter ends at 3.8/h² and 7.6/h². With a lumped mass, Kᵢᵢ/Mᵢᵢ is 2.7/h²,
# too close to the lowest quarter, which ends at 2.2/h² in 2D and 2.4/h² in 3D; therefore Gershgorin's bound is used. A
# constant potential moves s and the spectrum alike. For K = cM, all eigenvalues are s = c. If σ were s, solvers would
# find mixtures of their eigenvectors and those of the separate equations. So σ exceeds s by a hundredth of the largest
# |Kᵢᵢ/Mᵢᵢ| (or bound), or by 1 for K = 0. With a tenth, the Chebyshev filter took 13 rounds, not 4, for a lumped mass.
@jax.jit
def _with_others(
    stiffness: Float[Array, "offsets *shape"], mass: Float[Array, "m *shape"], free: Bool[np.ndarray | Array, "*shape"]
) -> tuple[Float[Array, "offsets *shape"], Float[Array, "m *shape"]]:
    of_stiffness, of_mass = len(stiffness) // 2, len(mass) // 2
    rows, unit = jax.lax.stop_gradient((stiffness, jnp.where(free, mass[of_mass], 0)))
    own = rows[of_stiffness]
    if len(mass) == 1:
        own = own + jnp.sum(jnp.abs(rows), axis=0) - jnp.abs(own)
    size = jnp.sum(unit) / jnp.sum(free).astype(unit.dtype)
    quotients = jnp.where(free, own, 0) / jnp.where(free, unit, 1)
    scale = jnp.max(jnp.abs(quotients))
    above = jnp.max(jnp.where(free, quotients, -jnp.inf)) + jnp.where(scale > 0, scale / 100, 1)
    others = jnp.where(free, 0, above * size), jnp.where(free, 0, size)
    return stiffness.at[of_stiffness].add(others[0]), mass.at[of_mass].add(others[1])
