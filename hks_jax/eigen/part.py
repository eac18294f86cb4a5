"""One pencil's lowest eigenpairs, with what is known of their quality."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hks_jax.compilation import jit_quickly
from hks_jax.eigen.derivative import lowest
from hks_jax.eigen.eigenpairs import Eigenpairs
from hks_jax.eigen.quality import indistinct, values_and_defects
from hks_jax.eigen.solver import Eigensolver
from hks_jax.fem.pencil import Pencil


def solve_part(pencil: Pencil, solver: Eigensolver, k: int, extra: int, name: str) -> Eigenpairs:
    """Return k + extra pairs of one pencil, the last ``extra`` of them without derivatives."""
    n_dof = pencil.space.n_dof
    if k + extra > solver.max_pairs(n_dof):
        raise ValueError(
            f"k: the {solver.name} solver gives at most {solver.max_pairs(n_dof)} of {n_dof} pairs, and {k + extra} "
            "are needed (with one more to see where the spectrum is cut, and the spare ones of multiplet='complete'). "
            "Use a smaller k or the dense solver"
        )
    values, vectors, frame, complete_below = lowest(solver, pencil, k, extra)
    residuals, converged, rounding = _quality(*jax.lax.stop_gradient((pencil, values, vectors)), solver.tolerance)
    return Eigenpairs(
        values,
        vectors,
        frame,
        residuals,
        converged,
        kept=jnp.ones(values.shape, bool),
        part=jnp.zeros(values.shape, int),
        next_eigenvalue=jnp.asarray(jnp.inf, values.dtype),
        complete_below=complete_below,
        multiplet_tolerance=jnp.clip(rounding[-1], 1e-6, 1e-3),
        pencil=pencil,
        solver_name=name,
    )


@jit_quickly(static_argnames="tolerance")
def _quality(
    pencil: Pencil, values: Float[Array, " k"], vectors: Float[Array, "k n_dof"], tolerance: float
) -> tuple[Array, Array, Array]:
    """Return residuals, whether they are small enough, and what rounding alone makes of them, each (k,)."""
    first = values[min(pencil.space.n_null, values.size - 1)]
    _, defect = values_and_defects(pencil, vectors, values)
    scale = jnp.maximum(jnp.abs(values), jnp.abs(first))
    scale = jnp.where(scale > 0, scale, 1)
    residuals = defect / scale
    # Rounding excuses a residual of a per cent at most: beyond that, the pair is not known, whatever the reason.
    rounding = indistinct(pencil, values.dtype) / scale
    converged = (residuals <= jnp.maximum(tolerance, jnp.minimum(rounding, 0.01))) & (values >= 0)
    return residuals, converged, rounding
