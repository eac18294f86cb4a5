"""One pencil's lowest eigenpairs, with what is known of their quality."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hks_jax.compilation import jit_quickly
from hks_jax.eigen.derivative import lowest
from hks_jax.eigen.eigenpairs import Eigenpairs
from hks_jax.eigen.quality import quality
from hks_jax.eigen.solver import Eigensolver, Report
from hks_jax.fem.pencil import Pencil
from hks_jax.linear.pencil import tabulated


def solve_part(
    pencil: Pencil, solver: Eigensolver, k: int, extra: int, name: str, throw: bool, report: Report
) -> Eigenpairs:
    """Return k pairs of one pencil and, where one ``extra`` is asked for, the next eigenvalue.

    With ``throw``, a derivative that does not converge is an error.
    """
    n_dof = pencil.space.n_dof
    if k + extra > solver.max_pairs(n_dof):
        raise ValueError(
            f"k: the {solver.name} solver gives at most {solver.max_pairs(n_dof)} of {n_dof} pairs, and {k + extra} "
            "are needed (with one more to see where the spectrum is cut, and the spare ones of multiplet='complete'). "
            "Use a smaller k or the dense solver"
        )
    values, vectors, frame, following, complete_below = lowest(solver, pencil, k, extra, throw, report)
    known = jax.lax.stop_gradient((tabulated(pencil), values, vectors))
    residuals, converged, *others = _quality(*known, solver.tolerance)
    kept, part, multiplet_tolerance = others
    return Eigenpairs(
        values,
        vectors,
        frame,
        residuals,
        converged,
        kept=kept,
        part=part,
        next_eigenvalue=following,
        complete_below=jnp.asarray(complete_below),  # of a constant JAX makes a number where it differentiates
        multiplet_tolerance=multiplet_tolerance,
        pencil=pencil,
        solver_name=name,
    )


@jit_quickly(static_argnames="tolerance")
def _quality(
    pencil: Pencil, values: Float[Array, " k"], vectors: Float[Array, "k n_dof"], tolerance: float
) -> tuple[Array, ...]:
    """Return residuals (k,), whether they are small enough (k,), and what `Eigenpairs` has of pairs not yet cut."""
    first = values[min(pencil.n_null, values.size - 1)]
    residuals, small, rounding = quality(pencil, values, vectors, first, tolerance)
    converged = small & (values >= 0)
    kept, part = jnp.ones(values.shape, bool), jnp.zeros(values.shape, int)
    return residuals, converged, kept, part, jnp.clip(rounding[-1], 1e-6, 1e-3)
