"""The lowest eigenpairs of one pencil, with residuals and convergence flags."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.arrays import jax_array
from hks_jax.compilation import is_concrete_on_cpu, jit_quickly, numpy_where_known
from hks_jax.eigen.adjoints.adjoint import Scalar
from hks_jax.eigen.derivative import solved
from hks_jax.eigen.eigenpairs import UNCERTAIN, Eigenpairs
from hks_jax.eigen.inertia import locate, translated
from hks_jax.eigen.lanczos.block_lanczos import BlockLanczos, known_by_weyl
from hks_jax.eigen.quality import allowed_residuals, indistinct, largest, largest_of, measure_pairs, measured_on_host
from hks_jax.eigen.rotations import with_rotations
from hks_jax.eigen.shift_invert.matrices import balanced, near_zero
from hks_jax.eigen.shift_invert.shift_invert import ShiftInvert, lower_bound
from hks_jax.eigen.solver import Dense, Eigensolver, Report
from hks_jax.fem.nodal import on_all_nodes
from hks_jax.fem.pencil import AnyPencil, Pencil
from hks_jax.fem.space import MatrixSpace
from hks_jax.linear.pencil import SymmetricPencil, tabulated
from hks_jax.traced import is_traced

_FAR = 30
"""The largest distance of the origin below the wanted eigenvalues, in units of the spread of these eigenvalues."""

_COPIES = 1000
"""The largest number of lowest eigenvalues that are all computed because rounding does not separate them."""


def widened(pencil: AnyPencil, solvers: Sequence[Eigensolver], k: int) -> AnyPencil:
    """Return the pencil `on_all_nodes`, so that all masks share compiled code; unchanged for the dense solver."""
    return pencil if any(isinstance(solver, Dense) for solver in solvers) else on_all_nodes(pencil, k)


def solve_lowest(pencil: Pencil, solver: Eigensolver, k: int, extra: int, throw: bool, report: Report) -> Eigenpairs:
    """Return the k lowest pairs and, if ``extra`` = 1, the next eigenvalue. See `solved` for ``throw``."""
    n_dof, pencil = pencil.size, _with_balance(pencil)
    if isinstance(solver, ShiftInvert) and not pencil.bounded and is_concrete_on_cpu(jax.lax.stop_gradient(pencil)):
        bound = lower_bound(jax.lax.stop_gradient(pencil))
        pencil = eqx.tree_at(lambda p: p.lower_bound, pencil, bound, is_leaf=lambda leaf: leaf is None)
    if not (pencil.bounded or solver.indefinite):
        raise ValueError(
            f"solver: got {solver.name!r}, which needs a positive semidefinite stiffness with a known null space; the "
            'null space is unknown. Use "block-lanczos" or "dense", or give `sparse_pencil` the null vectors'
        )
    if k + extra > solver.max_pairs(n_dof) and pencil.null_space is None:
        solver = Dense(solver.tolerance)
    elif k + extra > (most := solver.max_pairs(n_dof)):
        if most < 2:
            raise ValueError(
                f"solver: got {solver.name!r} for {n_dof} unknowns, which are too few for it. Use the dense solver"
            )
        raise ValueError(
            f"k: got {k}, for which {k + extra} pairs are needed (one more shows where the spectrum is cut); the "
            f"{solver.name} solver computes at most {most} of {n_dof} pairs. Use a smaller k or the dense solver"
        )
    from_bound = pencil.null_space is None and not solver.indefinite
    if not from_bound and (not isinstance(solver, BlockLanczos) or known_by_weyl(pencil)):
        found = solved(solver, pencil, k, extra, throw, report)
        return _pairs(pencil, pencil, jnp.zeros((), found[0].dtype), found, solver)
    number, method = k, solver
    if from_bound:
        assert pencil.lower_bound is not None
        origin = reach = spacing = jax.lax.stop_gradient(pencil.lower_bound)
    else:
        assert isinstance(solver, BlockLanczos)
        half = max(solver.plan(k).slice_size // 2, 1)
        origin, first, below = locate(jax.lax.stop_gradient(pencil), half, solver.block)
        reach, spacing = first - origin, (first - origin) / jnp.maximum(below, 1).astype(origin.dtype)
        if not is_traced(below) and 2 * half < below <= _COPIES:
            # The lowest eigenvalue has an unexpectedly high multiplicity. Compute all pairs that `locate` counted.
            number = max(k, int(below))
            method = solver if number + 1 <= solver.max_pairs(n_dof) else Dense(solver.tolerance)

    def solve(origin: Scalar, reach: Scalar, spacing: Scalar) -> tuple[SymmetricPencil, tuple[Any, ...]]:
        if from_bound:  # a solver for K ⪰ 0 gets K − σM, where σ is a lower bound of the spectrum
            moved: SymmetricPencil = pencil.counted_from(origin)
        else:
            moved = translated(pencil, origin, reach, spacing)
        return moved, solved(method, moved, number, min(extra, n_dof - number), throw, report)

    moved, found = solve(origin, reach, spacing)
    values = jax.lax.stop_gradient(found[0])
    spread = values[-1] - values[0]
    if not is_traced(values) and spread > indistinct(moved, values.dtype) and values[0] > _FAR * spread:
        # Solve again from an origin nearer to the spectrum, because distances of eigenvalues from a remote origin have
        # fewer correct digits. If all eigenvalues are equal, the lost digits do not matter.
        origin = origin + values[0] - spread
        moved, found = solve(origin, 2 * spread, spread / number)
    if number > k:
        (values, frame, _, bound), chosen = found, np.arange(number) < k
        constant = jax.lax.stop_gradient(values + origin)
        frame = with_rotations(frame, constant, chosen[:, None] & ~chosen[None], None, pencil)
        found = values[:k], frame[:k], jax.lax.stop_gradient(values[k]), bound
    return _pairs(pencil, moved, origin, found, method)


def _with_balance(pencil: Pencil) -> Pencil:
    """Return a float32 pencil of the user's own K with the null vectors of K that rounding hides; see `balanced`."""
    known, own = jax.lax.stop_gradient(pencil), isinstance(pencil.space, MatrixSpace) or pencil.volume is None
    if pencil.null_space is not None or not own or not _single_on_host(known.stiffness, known.stiffness):
        return pencil
    source = replace(known.unrounded, null_vectors=balanced(known))
    return replace(pencil, source=source)


def _single_on_host(values: Any, args: Any) -> bool:
    return values.dtype == np.float32 and is_concrete_on_cpu(args)


def _pairs(
    pencil: Pencil,
    solved_pencil: SymmetricPencil,
    origin: Scalar,
    found: tuple[Any, ...],
    solver: Eigensolver,
) -> Eigenpairs:
    """Return the `Eigenpairs` of a pencil, given the pairs of K − σ₀M and M for an origin σ₀."""
    values, frame, following, bound = found
    known = solved_pencil is pencil and pencil.null_space is not None
    matrices = tabulated(SymmetricPencil(solved_pencil.stiffness, solved_pencil.mass))
    held = jax.lax.stop_gradient((matrices, values, frame, origin))
    stored = solver.in_double and _single_on_host(values, held)
    quality = _quality(*held, solved_pencil.n_null, solver.tolerance, known, stored)
    residuals, converged, zero, tolerance = quality
    constants = jax.lax.stop_gradient((solved_pencil, frame, values, origin, zero))
    small, rounding = _near_zero(*constants, known, solver)
    # While differentiating, JAX may turn a constant array into a Python number.
    following, bound = jax_array(following), jax_array(bound)
    if not known:
        constant = jax.lax.stop_gradient(values)
        values, following, bound = _translated(values, constant, zero, small, following, bound, origin)
    return Eigenpairs(
        eigenvalues=values,
        residuals=residuals,
        converged=converged,
        rounding=rounding,
        kept=jax_array(np.ones(values.size, bool)),
        next_eigenvalue=following,
        complete_below=bound,
        spectral_origin=origin if known else jax.lax.stop_gradient(values[0]),
        multiplet_tolerance=tolerance,
        part=None,
        frame=frame,
        pencil=pencil,
        solver_name=solver.name,
    )


@numpy_where_known(jit_quickly())
def _translated(
    xp: Any, values: Any, constant: Any, zero: Any, small: Any, following: Any, bound: Any, origin: Any
) -> tuple[Any, Any, Any]:
    """Add the origin to values and bounds. Eigenvalues near zero become ``small``, and keep their derivatives."""
    return xp.where(zero, small + (values - constant), values + origin), following + origin, bound + origin


def _near_zero(
    pencil: SymmetricPencil,
    vectors: Array,
    values: Array,
    origin: Scalar,
    zero: Array,
    known: bool,
    solver: Eigensolver,
) -> tuple[Float[Array, " k"], Float[Array, " k"]]:
    """Return the eigenvalues that are zero within rounding, with 0 for the others, and `Eigenpairs.rounding`.

    In float32, eigenvalues that are zero within rounding may be accurate in float64, in which the host computes.
    """
    nothing = jax_array(np.zeros(values.shape, values.dtype))
    if values.dtype != np.float32:
        return nothing, nothing
    if not _single_on_host(values, (pencil, vectors, values)):
        return nothing, nothing if known else jnp.where(zero, indistinct(pencil, values.dtype), 0)
    small, rounding = np.zeros((2, values.size), np.float32)
    near = np.abs(np.asarray(values) + np.asarray(origin)) <= float(indistinct(pencil, values.dtype)) / UNCERTAIN
    where = np.flatnonzero(near & (np.arange(values.size) >= (pencil.n_null if known else 0)))
    if where.size:
        quotients, changes = near_zero(pencil, np.asarray(vectors)[where], solver.in_double)
        # Rounding of the vectors to float32 changes quotients by its square.
        exact = np.abs(quotients) <= np.finfo(np.float32).eps ** 2 * float(largest(pencil))
        small[where], rounding[where] = np.where(exact, 0, quotients), np.where(exact, 0, changes)
        small[where] = np.maximum.accumulate(small[where])
    return jax.device_put((small, rounding))


@numpy_where_known(jit_quickly(static_argnames=("n_null", "tolerance", "known", "stored")), most=3 << 18)
def _quality(
    xp: Any,
    pencil: Any,
    values: Any,
    vectors: Any,
    origin: Any,
    n_null: int,
    tolerance: float,
    known: bool,
    stored: bool,
) -> tuple[Any, ...]:
    """Return residuals, convergence flags, flags of zero eigenvalues, and the multiplet tolerance.

    Each residual is divided by the distance of its eigenvalue from the origin, but at least by the first positive
    eigenvalue if the null space is known, by `largest_of` if all eigenvalues are zero, and otherwise by the mean gap.
    """
    measure = measured_on_host if xp is np else measure_pairs
    (_, residuals, twice), k = measure(pencil, vectors, values), values.size
    size = largest_of(xp, pencil.stiffness, pencil.mass)
    rounding = 4 * xp.finfo(values.dtype).eps * size
    zero = xp.abs(values + origin) <= rounding
    unit = values[min(n_null, k - 1)] if known else xp.where(xp.all(zero), size, (values[-1] - values[0]) / k)
    scale = xp.maximum(xp.abs(values), xp.abs(unit))
    scale = xp.where(scale > 0, scale, xp.where(size > 0, size, 1)).astype(values.dtype)
    converged = (residuals <= allowed_residuals(scale, rounding, tolerance, xp, stored)) & ~twice
    converged = converged & (values >= 0) if known else converged
    return residuals / scale, converged, zero, xp.clip(rounding / scale[-1], 1e-6, 1e-3).astype(values.dtype)
