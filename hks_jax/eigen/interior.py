"""The eigenpairs from an origin within the spectrum upwards, and guards on both sides of them."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from hks_jax.eigen.dense import Dense
from hks_jax.eigen.lanczos.block_lanczos import BlockLanczos
from hks_jax.eigen.origin import LocatedPencil, lowered, translated
from hks_jax.eigen.solver import Eigensolver, RawPairs, Report


def first_from_origin(solver: Eigensolver, k: int, guards: int, report: Report, pencil: LocatedPencil) -> RawPairs:
    """Return the first k pairs from the origin, then the guards: those that follow, and those before the origin.

    Where the spectrum has fewer guards the others are zero vectors, with the eigenvalue of the first pair.
    """
    if isinstance(solver, Dense):
        values, vectors, bound = solver.lowest(pencil, pencil.size)
        values, vectors = _from(pencil.negative, pencil.size, values, vectors)
        return values[: k + guards], vectors[: k + guards], bound
    if guards == 0:
        return solver.lowest(pencil, k, report)
    assert isinstance(solver, BlockLanczos)
    distance, before = lowered(pencil, guards // 2, solver.block)
    moved = translated(pencil, -distance, pencil.negative - before, pencil.first + distance, pencil.spacing)
    values, vectors, bound = solver.lowest(moved, k + guards, report)
    return *_from(before, pencil.size - moved.negative, values - distance, vectors), bound - distance


@jax.jit
def _from(
    first: Int[Array, ""], existing: Int[Array, ""] | int, values: Float[Array, " p"], vectors: Float[Array, "p n_dof"]
) -> tuple[Float[Array, " p"], Float[Array, "p n_dof"]]:
    """Return pairs from the first wanted one on, then those before it."""
    there = jnp.arange(values.size) < existing
    values, vectors = jnp.where(there, values, values[first]), jnp.where(there[:, None], vectors, 0)
    return jnp.roll(values, -first), jnp.roll(vectors, -first, axis=0)
