"""The eigenpairs of a pencil in an interval, and their derivatives with respect to stiffness and mass."""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from hks_jax.eigen.complement.interior import InteriorAdjoint
from hks_jax.eigen.dense import Dense
from hks_jax.eigen.derivative import Certified, Telling, prepare, tangents_of
from hks_jax.eigen.first_order import first_order_only
from hks_jax.eigen.lanczos.block_lanczos import BlockLanczos
from hks_jax.eigen.located import LocatedPencil, lowered, translated
from hks_jax.eigen.solver import RawPairs, Report
from hks_jax.linear.one_by_one import one_by_one
from hks_jax.traced import is_traced


@partial(jax.custom_jvp, nondiff_argnums=(0, 2, 3, 4))
def in_interval(solver: BlockLanczos | Dense, pencil: LocatedPencil, k: int, throw: bool, report: Report) -> Certified:
    """Return the first k eigenvalues from the origin, their eigenvectors, these again as the frame, and the bound.

    All of it as `hks_jax.eigen.derivative.lowest` has it.
    """
    values, vectors, bound = one_by_one(_solve, (solver, k, 0, report), pencil)
    return values, vectors, vectors, bound


# The formulas below `hks_jax.eigen.derivative.lowest` hold wherever in the spectrum the k pairs are. Only the linear
# solves differ, since eigenvalues are left on both sides: guards are needed on both sides, too. How many there are in
# all is static, how many on each side is not: the origin is lowered past at most half of them, and the rest are those
# that follow the interval.
@in_interval.defjvp
def _in_interval_jvp(
    solver: BlockLanczos | Dense,
    k: int,
    throw: bool,
    report: Report,
    primals: tuple[LocatedPencil],
    changes: tuple[LocatedPencil],
) -> tuple[Certified, Certified]:
    pencil, change = first_order_only(primals[0]), changes[0]
    room = min(solver.max_pairs(pencil.size), pencil.size) - k
    guards = max(min(2 * solver.guards(k, pencil.size), room), 0)
    values, vectors, bound = one_by_one(_solve, (solver, k, guards, report), pencil)
    telling: Telling = "error" if throw else "nothing" if is_traced(primals) else "warning"
    adjoint = InteriorAdjoint(solver.adjoint.tolerance)
    prepared = prepare(adjoint, k, pencil, values)
    functions = vectors[:k]
    tangents = tangents_of(adjoint, telling, prepared, pencil, change, values, vectors, functions)
    return (values[:k], functions, functions, bound), (*tangents, jnp.zeros_like(bound))


def _solve(solver: BlockLanczos | Dense, k: int, guards: int, report: Report, pencil: LocatedPencil) -> RawPairs:
    """Return the first k pairs from the origin, then so many guards: those that follow, and those before the origin.

    Where the spectrum has fewer guards the others are zero vectors, with the eigenvalue of the first pair.
    """
    if isinstance(solver, Dense):
        values, vectors, bound = solver.lowest(pencil, pencil.size)
        values, vectors = _from(pencil.negative, pencil.size, values, vectors)
        return values[: k + guards], vectors[: k + guards], bound
    if guards == 0:
        return solver.lowest(pencil, k, report)
    distance, before = lowered(pencil, guards // 2, solver.block)
    moved = translated(pencil, -distance, pencil.negative - before, pencil.first + distance, pencil.spacing)
    values, vectors, bound = solver.lowest(moved, k + guards, report)
    return *_from(before, pencil.size - moved.negative, values - distance, vectors), bound - distance


@jax.jit
def _from(
    first: Int[Array, ""], existing: Int[Array, ""] | int, values: Float[Array, " p"], vectors: Float[Array, "p n_dof"]
) -> tuple[Float[Array, " p"], Float[Array, "p n_dof"]]:
    """Return pairs from the first wanted one on, then those before it; of so many that exist."""
    there = jnp.arange(values.size) < existing
    values, vectors = jnp.where(there, values, values[first]), jnp.where(there[:, None], vectors, 0)
    return jnp.roll(values, -first), jnp.roll(vectors, -first, axis=0)
