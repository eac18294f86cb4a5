"""The pencil of a masked grid on all of the grid's nodes: what is compiled for it serves every mask."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hks_jax.domain.grid import Grid
from hks_jax.fem.pencil import AnyPencil, MirrorPencil, Pencil
from hks_jax.fem.space import GridSpace, grid_space
from hks_jax.fem.stencil import StencilOperator, coefficients_of
from hks_jax.linear.operators import DiagonalOperator, Operator
from hks_jax.linear.pencil import NullSpace
from hks_jax.traced import is_traced

_FILLED = {2: 0.45, 3: 0.6}
"""The least share of free nodes, by dimension. With half of them, later calls are 1.4 to 1.9 times slower in 2D, which
some ten of them take to lose what the first one gains; factors of volumes grow faster."""


def on_all_nodes(pencil: AnyPencil, k: int = 0) -> AnyPencil:
    """Return a pencil on all nodes of a grid, whose lowest eigenpairs are those of the pencil given, if that pays.

    Each node that is not free is an equation of its own, Kᵢᵢ = σMᵢᵢ, with an eigenvalue σ above the lowest quarter of
    the spectrum; eigenvectors of others vanish there. The pencil is returned as it is where more than that quarter is
    wanted, k pairs, and where values are traced, as the computation is compiled for its mask in any case.
    """
    parts = tuple(_of_one(part) if 4 * k <= part.size else part for part in pencil.parts)
    return parts[0] if isinstance(pencil, Pencil) else MirrorPencil(parts, pencil.including)


def _of_one(pencil: Pencil) -> Pencil:
    space = pencil.space
    known = not is_traced(jax.lax.stop_gradient(pencil.stiffness))
    if not (
        known
        and isinstance(space, GridSpace)
        and _FILLED[space.dimension] * space.free.size <= space.n_dof < space.free.size
    ):
        return pencil
    natural = ("neumann", "neumann")
    sides = [("periodic", "periodic") if wraps else natural for wraps in space.periodic]
    whole = grid_space(Grid(space.node_shape), (*sides, natural))
    of_stiffness, of_mass = (coefficients_of(each, space) for each in (pencil.stiffness, pencil.mass))
    of_stiffness, of_mass = _with_others(of_stiffness, of_mass, space.free)
    diagonal = isinstance(pencil.mass, DiagonalOperator)
    mass: Operator = DiagonalOperator(of_mass.ravel()) if diagonal else StencilOperator(of_mass, whole)
    nulls = pencil.null_space
    if nulls is not None:
        vectors = space.extend(nulls.vectors, outside=0.0)
        nulls = NullSpace(vectors.reshape(len(vectors), whole.n_dof), nulls.fixed)
    sums = pencil.row_sums
    if sums is not None:  # with infinite ones, nothing is read from neighbours
        sums = jnp.where(space.free, space.extend(sums, outside=0.0), jnp.inf).ravel()
    known_of_it = StencilOperator(of_stiffness, whole), mass, pencil.metric, pencil.volume, whole
    return Pencil(*known_of_it, null_space=nulls, lower_bound=pencil.lower_bound, row_sums=sums)


# A Rayleigh quotient, the largest Kᵢᵢ/Mᵢᵢ is no more than the largest eigenvalue: the spectrum becomes no wider. It is
# more than the lowest quarter of the spectrum: on a uniform grid with the consistent mass it is 6/h² in 2D and 9/h² in
# 3D, where by Weyl's law that quarter ends at 3.1/h² and 6/h². With a lumped mass it is 2.7/h² in both, hence the
# factor.
@jax.jit
def _with_others(
    stiffness: Float[Array, "offsets *shape"], mass: Float[Array, "m *shape"], free: Bool[np.ndarray | Array, "*shape"]
) -> tuple[Float[Array, "offsets *shape"], Float[Array, "m *shape"]]:
    """Return the coefficients with an equation of its own for each node that is not free."""
    of_stiffness, of_mass = len(stiffness) // 2, len(mass) // 2
    diagonals = jax.lax.stop_gradient((stiffness[of_stiffness], mass[of_mass]))
    own, unit = (jnp.where(free, diagonal, 0) for diagonal in diagonals)
    size = jnp.sum(unit) / jnp.sum(free).astype(unit.dtype)
    above = (2.0 if len(mass) == 1 else 1.0) * jnp.max(own / jnp.where(free, unit, 1)) * size
    others = jnp.where(free, 0, above), jnp.where(free, 0, size)
    return stiffness.at[of_stiffness].add(others[0]), mass.at[of_mass].add(others[1])
