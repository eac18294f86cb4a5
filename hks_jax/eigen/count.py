"""How many eigenvalues lie below a number, without computing any."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from hks_jax.domain.surface_mesh import SurfaceMesh
from hks_jax.domain.tensor_field import TensorField
from hks_jax.eigen.dissection import dissect
from hks_jax.eigen.host import factorise_on_host, host_matrices
from hks_jax.eigen.multifrontal import factorise
from hks_jax.fem.assembly import MassKind, assemble
from hks_jax.fem.boundary import BoundarySpec
from hks_jax.fem.operators import StencilOperator
from hks_jax.fem.pencil import MirrorPencil, Pencil
from hks_jax.fem.space import GridSpace


def count_eigenvalues(
    domain: TensorField | SurfaceMesh | Pencil | MirrorPencil,
    below: Float[Array, ""] | float,
    boundary: BoundarySpec = "neumann",
    mass: MassKind = "consistent",
) -> Int[Array, ""]:
    """Count the eigenvalues below a number, with their multiplicities.

    By Sylvester's law of inertia these are the negative eigenvalues of K − σM, which a factorisation LDLᵀ shows: one
    factorisation certifies that a list of eigenvalues is complete. Traceable on grids; on meshes SuperLU counts, on
    the host.

    Args:
        domain: a tensor field, a surface mesh, or a pencil from `assemble`.
        below: σ, in 1/(metric length)²; not itself an eigenvalue, where the count is uncertain.
        boundary: see `assemble`; belongs to the pencil if one is given.
        mass: likewise.

    Returns:
        How many eigenvalues are less than σ.
    """
    pencil = domain if isinstance(domain, Pencil | MirrorPencil) else assemble(domain, boundary, mass)
    return jnp.asarray(sum(_count(part, jnp.asarray(below, part.stiffness.dtype)) for part in pencil.parts))


def _count(pencil: Pencil, below: Float[Array, ""]) -> Int[Array, ""]:
    if isinstance(pencil.stiffness, StencilOperator) and isinstance(pencil.space, GridSpace):
        return factorise(dissect(pencil.space), pencil, below).negative
    data, matrices = host_matrices(pencil)
    K, M = matrices(*map(np.asarray, data))
    return jnp.asarray(int((factorise_on_host(K - float(below) * M).U.diagonal() < 0).sum()))
