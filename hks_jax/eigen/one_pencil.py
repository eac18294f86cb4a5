"""The lowest eigenpairs of one pencil, with residuals and convergence flags."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.arrays import jax_array
from hks_jax.compilation import is_concrete_on_cpu, library_of, numpy_where_known
from hks_jax.eigen.derivative import solved
from hks_jax.eigen.eigenpairs import UNCERTAIN, PencilEigenpairs
from hks_jax.eigen.quality import (
    allowed_residuals,
    indistinct,
    largest,
    largest_of,
    measure_pairs,
    measured_on_host,
    rounding_of_quotients,
)
from hks_jax.eigen.solver import Dense, Eigensolver, Report
from hks_jax.fem.box import Box, in_box
from hks_jax.fem.pencil import Pencil
from hks_jax.fem.space import MatrixSpace
from hks_jax.linear.host_matrices import balanced, near_zero
from hks_jax.linear.symmetric_pencil import SymmetricPencil, tabulated

_REPEATED = 100
"""The largest effect of repeated rounding in sums over all nodes, in units of the effect of rounding once."""


def pairs_of_pencil(
    pencil: Pencil,
    solver: Eigensolver,
    k: int,
    throw: bool,
    report: Report,
    start: PencilEigenpairs | None = None,
) -> PencilEigenpairs:
    """Return the k lowest pairs, from those of a similar pencil (``start``). See `solved` for ``throw``."""
    extra = min(1, pencil.size - k)  # the next eigenvalue shows whether k cuts a multiple eigenvalue
    solver = _able(solver, pencil, k, extra)
    box = Box(pencil, pencil.space) if isinstance(solver, Dense) else in_box(pencil, k + extra)
    boxed, rows = box.pencil, None
    if start is not None and start.spare is not None:
        rows = start.space.transfer(jnp.concatenate([start.frame, start.spare]), pencil.space)
        rows = box.into(rows)
    # NumPy computes in float64, and finds null vectors and eigenvalues near zero that rounding to float32 hides.
    on_host = is_concrete_on_cpu(jax.lax.stop_gradient((boxed, rows)))
    boxed = _with_balance(boxed) if on_host and boxed.stiffness.dtype == np.float32 else boxed
    values, frame, following, bound, spare = solved(solver, boxed, k, extra, throw, report, rows)
    # While differentiating, JAX may turn a constant array into a Python number.
    following, bound = jax_array(following), jax_array(bound)
    values, quality = _judged(boxed, solver, values, frame, following, on_host)
    return PencilEigenpairs(
        eigenvalues=values,
        kept=jax_array(np.ones(k, bool)),
        next_eigenvalue=following,
        complete_below=bound,
        frame=box.out_of(frame),
        pencil=pencil,
        solver_name=solver.name,
        spare=None if spare is None else box.out_of(spare),
        **quality,
    )


def _able(solver: Eigensolver, pencil: Pencil, k: int, extra: int) -> Eigensolver:
    """Return the solver, or the dense one if the solver cannot compute k pairs and K may be indefinite.

    Raises ValueError if the solver does not support the pencil, or cannot compute k pairs.
    """
    solver.require(pencil)
    n_dof, most = pencil.size, solver.max_pairs(pencil.size)
    if k + extra <= most:
        return solver
    if pencil.null_space is None:
        return Dense(solver.tolerance)
    if most < 2:
        raise ValueError(
            f"solver: got {solver.name!r} for {n_dof} unknowns, which are too few for it. Use the dense solver"
        )
    raise ValueError(
        f"k: got {k}, for which {k + extra} pairs are needed (one more shows where the spectrum is cut); the "
        f"{solver.name} solver computes at most {most} of {n_dof} pairs. Use a smaller k or the dense solver"
    )


def _with_balance(pencil: Pencil) -> Pencil:
    """Return the pencil of the user's own K with the null vectors that rounding to float32 hides; see `balanced`."""
    custom = isinstance(pencil.space, MatrixSpace) or pencil.volume is None
    if pencil.null_space is not None or not custom:
        return pencil
    constant = jax.lax.stop_gradient(pencil)
    return replace(pencil, source=replace(constant.unrounded, null_vectors=balanced(constant)))


def _judged(
    pencil: Pencil, solver: Eigensolver, values: Array, vectors: Array, following: Array, on_host: bool
) -> tuple[Array, dict[str, Array]]:
    """Return the eigenvalues, where those near zero may be more accurate, and the indicators of the pairs' quality."""
    null_space_known = pencil.null_space is not None
    constants = jax.lax.stop_gradient((pencil, vectors, values, following))
    matrices = tabulated(SymmetricPencil(constants[0].stiffness, constants[0].mass))
    accurate = solver.in_double and on_host and values.dtype == np.float32
    settings = pencil.n_null, solver.tolerance, null_space_known, accurate
    residuals, converged, zero, tolerance = _quality(matrices, *constants[1:], constants[0].lower_bound, *settings)
    small, rounding = _near_zero(*constants[:3], zero, accurate, on_host)
    if not null_space_known:
        values = _with_small(values, constants[2], zero, small)
    origin = jnp.zeros((), values.dtype) if null_space_known else jax.lax.stop_gradient(values[0])
    return values, {
        "residuals": residuals,
        "converged": converged,
        "rounding": rounding,
        "multiplet_tolerance": tolerance,
        "spectral_origin": origin,
    }


@numpy_where_known()
def _with_small(values: Any, constant: Any, zero: Any, small: Any) -> Any:
    """Replace eigenvalues near zero by ``small``; they keep their derivatives."""
    xp = library_of(values)
    return xp.where(zero, small + (values - constant), values)


def _near_zero(
    pencil: Pencil, vectors: Array, values: Array, zero: Array, accurate: bool, on_host: bool
) -> tuple[Float[Array, " k"], Float[Array, " k"]]:
    """Return the eigenvalues that are zero within rounding, with 0 for the others, and `Eigenpairs.rounding`.

    In float32, eigenvalues that are zero within rounding may be accurate in float64, in which the host computes. In
    float64, they may be accurate if their eigenvectors are small where entries of K are large.
    ``accurate`` states whether the solver computed float32 pairs in float64.
    """
    dtype, single, null_space_known = values.dtype, values.dtype == np.float32, pencil.null_space is not None
    nothing = jax_array(np.zeros(values.shape, dtype))
    if not on_host:
        return nothing, jnp.where(zero, indistinct(pencil, dtype), 0) if single and not null_space_known else nothing
    near = np.asarray(zero) & (not null_space_known)
    if single:
        near = np.abs(np.asarray(values)) <= float(indistinct(pencil, dtype)) / UNCERTAIN
        near &= np.arange(values.size) >= pencil.n_null
    where = np.flatnonzero(near)
    if not where.size:
        return nothing, nothing
    small, rounding = np.zeros((2, values.size), dtype)
    if null_space_known and not accurate:
        rounding[where] = rounding_of_quotients(pencil, vectors, where)
        return jax.device_put((small, rounding))
    quotients, changes, residuals = near_zero(pencil, np.asarray(vectors)[where], accurate)
    # Rounding of the vectors changes quotients by its square. In float64, sums over many nodes round repeatedly.
    least: Any = (np.finfo(dtype).eps * (1 if single else _REPEATED)) ** 2 * float(largest(pencil))
    if not single:
        least, changes = np.maximum(_REPEATED * changes, least), np.maximum(changes, residuals)
    sure = np.abs(quotients) > least
    small[where], rounding[where] = np.maximum.accumulate(np.where(sure, quotients, 0)), np.where(sure, changes, 0)
    return jax.device_put((small, rounding))


@numpy_where_known(most=3 << 18, static_argnames=("n_null", "tolerance", "null_space_known", "stored"))
def _quality(
    pencil: Any,
    vectors: Any,
    values: Any,
    following: Any,
    lower_bound: Any,
    n_null: int,
    tolerance: float,
    null_space_known: bool,
    stored: bool,
) -> tuple[Any, ...]:
    """Return residuals, convergence flags, flags of zero eigenvalues, and the multiplet tolerance.

    If the null space is known, each residual is divided by its eigenvalue, but at least by the first positive one.
    Otherwise it is divided by the distance of its eigenvalue from the lowest one, or from a known lower bound, but at
    least by the mean gap. If all eigenvalues are equal within rounding, the divisor is the result of `largest_of`.
    """
    xp = library_of(values)
    measure = measured_on_host if xp is np else measure_pairs
    (_, residuals, twice), k = measure(pencil, vectors, values), values.size
    size = largest_of(pencil.stiffness, pencil.mass)
    rounding = 4 * xp.finfo(values.dtype).eps * size
    if null_space_known:
        scale = xp.maximum(xp.abs(values), xp.abs(values[min(n_null, k - 1)]))
    else:
        last = xp.where(xp.isfinite(following), following, values[-1])
        lowest = values[0] if lower_bound is None else lower_bound
        scale = xp.maximum(values - lowest, (last - values[0]) / k)
        scale = xp.where(scale > 100 * rounding, scale, size)
    scale = xp.where(scale > 0, scale, xp.where(size > 0, size, 1)).astype(values.dtype)
    converged = (residuals <= allowed_residuals(scale, rounding, tolerance, stored)) & ~twice
    converged = converged & (values >= 0) if null_space_known else converged
    tolerance = xp.clip(rounding / scale[-1], 1e-6, 1e-3).astype(values.dtype)
    return residuals / scale, converged, xp.abs(values) <= rounding, tolerance
