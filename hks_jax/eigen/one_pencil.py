"""The lowest eigenpairs of one pencil, with residuals and convergence flags."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.arrays import jax_array
from hks_jax.compilation import is_concrete_on_cpu, numpy_where_known
from hks_jax.eigen.derivative import solved
from hks_jax.eigen.eigenpairs import UNCERTAIN, PencilEigenpairs
from hks_jax.eigen.quality import allowed_residuals, indistinct, largest, largest_of, measure_pairs, measured_on_host
from hks_jax.eigen.solver import Dense, Eigensolver, Report
from hks_jax.fem.box import from_box, in_box, to_box
from hks_jax.fem.pencil import Pencil
from hks_jax.fem.space import MatrixSpace
from hks_jax.linear.host_matrices import balanced, near_zero
from hks_jax.linear.symmetric_pencil import SymmetricPencil, tabulated


def pairs_of_pencil(
    pencil: Pencil,
    solver: Eigensolver,
    k: int,
    extra: int,
    throw: bool,
    report: Report,
    start: PencilEigenpairs | None = None,
) -> PencilEigenpairs:
    """Return the k lowest pairs and, if ``extra`` = 1, the next eigenvalue. See `solved` for ``throw``."""
    given, pencil = pencil, pencil if isinstance(solver, Dense) else in_box(pencil, k + extra)
    solver.require(pencil)
    pencil, n_dof, most = _with_balance(pencil), pencil.size, solver.max_pairs(pencil.size)
    if k + extra > most and pencil.null_space is None:
        solver = Dense(solver.tolerance)
    elif k + extra > most:
        if most < 2:
            raise ValueError(
                f"solver: got {solver.name!r} for {n_dof} unknowns, which are too few for it. Use the dense solver"
            )
        raise ValueError(
            f"k: got {k}, for which {k + extra} pairs are needed (one more shows where the spectrum is cut); the "
            f"{solver.name} solver computes at most {most} of {n_dof} pairs. Use a smaller k or the dense solver"
        )
    rows = None
    if start is not None and start.spare is not None:
        rows = start.space.transfer(jnp.concatenate([start.frame, start.spare]), given.space)
        rows = to_box(rows, given.space, pencil.space)
    pairs = _pairs(pencil, solved(solver, pencil, k, extra, throw, report, rows), solver)
    frame = from_box(pairs.frame, pencil.space, given.space)
    spare = None if pairs.spare is None else from_box(pairs.spare, pencil.space, given.space)
    return replace(pairs, frame=frame, spare=spare, pencil=given)


def _with_balance(pencil: Pencil) -> Pencil:
    """Return a float32 pencil of the user's own K with the null vectors of K that rounding hides; see `balanced`."""
    known, own = jax.lax.stop_gradient(pencil), isinstance(pencil.space, MatrixSpace) or pencil.volume is None
    if pencil.null_space is not None or not own or not _single_on_host(known.stiffness, known.stiffness):
        return pencil
    source = replace(known.unrounded, null_vectors=balanced(known))
    return replace(pencil, source=source)


def _single_on_host(values: Any, args: Any) -> bool:
    return values.dtype == np.float32 and is_concrete_on_cpu(args)


def _pairs(pencil: Pencil, found: tuple[Any, ...], solver: Eigensolver) -> PencilEigenpairs:
    """Return the `PencilEigenpairs` of a pencil, given the result of `solved`."""
    values, frame, following, bound, spare = found
    known, double = pencil.null_space is not None, solver.in_double
    constants = jax.lax.stop_gradient((pencil, frame, values, following))
    matrices = tabulated(SymmetricPencil(constants[0].stiffness, constants[0].mass))
    stored = double and _single_on_host(values, constants)
    settings = pencil.n_null, solver.tolerance, known, stored
    quality = _quality(matrices, *constants[1:], constants[0].lower_bound, *settings)
    residuals, converged, zero, tolerance = quality
    small, rounding = _near_zero(*constants[:3], zero, double)
    if not known:
        values = _with_small(values, constants[2], zero, small)
    # While differentiating, JAX may turn a constant array into a Python number.
    return PencilEigenpairs(
        eigenvalues=values,
        residuals=residuals,
        converged=converged,
        rounding=rounding,
        kept=jax_array(np.ones(values.size, bool)),
        next_eigenvalue=jax_array(following),
        complete_below=jax_array(bound),
        spectral_origin=jnp.zeros((), values.dtype) if known else jax.lax.stop_gradient(values[0]),
        multiplet_tolerance=tolerance,
        frame=frame,
        pencil=pencil,
        solver_name=solver.name,
        spare=spare,
    )


@numpy_where_known()
def _with_small(xp: Any, values: Any, constant: Any, zero: Any, small: Any) -> Any:
    """Replace eigenvalues near zero by ``small``; they keep their derivatives."""
    return xp.where(zero, small + (values - constant), values)


def _near_zero(
    pencil: Pencil, vectors: Array, values: Array, zero: Array, accurate: bool
) -> tuple[Float[Array, " k"], Float[Array, " k"]]:
    """Return the eigenvalues that are zero within rounding, with 0 for the others, and `Eigenpairs.rounding`.

    In float32, eigenvalues that are zero within rounding may be accurate in float64, in which the host computes.
    ``accurate`` states whether the solver computed in float64.
    """
    nothing, known = jax_array(np.zeros(values.shape, values.dtype)), pencil.null_space is not None
    if values.dtype != np.float32:
        return nothing, nothing
    if not _single_on_host(values, (pencil, vectors, values)):
        return nothing, nothing if known else jnp.where(zero, indistinct(pencil, values.dtype), 0)
    small, rounding = np.zeros((2, values.size), np.float32)
    near = np.abs(np.asarray(values)) <= float(indistinct(pencil, values.dtype)) / UNCERTAIN
    where = np.flatnonzero(near & (np.arange(values.size) >= pencil.n_null))
    if where.size:
        quotients, changes = near_zero(pencil, np.asarray(vectors)[where], accurate)
        # Rounding of the vectors to float32 changes quotients by its square.
        exact = np.abs(quotients) <= np.finfo(np.float32).eps ** 2 * float(largest(pencil))
        small[where], rounding[where] = np.where(exact, 0, quotients), np.where(exact, 0, changes)
        small[where] = np.maximum.accumulate(small[where])
    return jax.device_put((small, rounding))


@numpy_where_known(most=3 << 18, static_argnames=("n_null", "tolerance", "known", "stored"))
def _quality(
    xp: Any,
    pencil: Any,
    vectors: Any,
    values: Any,
    following: Any,
    lower_bound: Any,
    n_null: int,
    tolerance: float,
    known: bool,
    stored: bool,
) -> tuple[Any, ...]:
    """Return residuals, convergence flags, flags of zero eigenvalues, and the multiplet tolerance.

    If the null space is known, each residual is divided by its eigenvalue, but at least by the first positive one.
    Otherwise it is divided by the distance of its eigenvalue from the lowest one, or from a known lower bound, but at
    least by the mean gap. If all eigenvalues are equal within rounding, the divisor is the result of `largest_of`.
    """
    measure = measured_on_host if xp is np else measure_pairs
    (_, residuals, twice), k = measure(pencil, vectors, values), values.size
    size = largest_of(xp, pencil.stiffness, pencil.mass)
    rounding = 4 * xp.finfo(values.dtype).eps * size
    if known:
        scale = xp.maximum(xp.abs(values), xp.abs(values[min(n_null, k - 1)]))
    else:
        last = xp.where(xp.isfinite(following), following, values[-1])
        lowest = values[0] if lower_bound is None else lower_bound
        scale = xp.maximum(values - lowest, (last - values[0]) / k)
        scale = xp.where(scale > 100 * rounding, scale, size)
    scale = xp.where(scale > 0, scale, xp.where(size > 0, size, 1)).astype(values.dtype)
    converged = (residuals <= allowed_residuals(scale, rounding, tolerance, xp, stored)) & ~twice
    converged = converged & (values >= 0) if known else converged
    tolerance = xp.clip(rounding / scale[-1], 1e-6, 1e-3).astype(values.dtype)
    return residuals / scale, converged, xp.abs(values) <= rounding, tolerance
