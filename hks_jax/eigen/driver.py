"""The driver: assemble, choose a solver, truncate, report."""

from typing import Any, get_args

import equinox as eqx
import jax
import numpy as np

from hks_jax.accuracy import warn_of_accuracy
from hks_jax.eigen.automatic import choose_solver
from hks_jax.eigen.dense import Dense
from hks_jax.eigen.derivative import of_simple
from hks_jax.eigen.doubled import merge, solve_doubled
from hks_jax.eigen.eigenpairs import RESULTS, SPARE, Eigenpairs, MultipletChoice, truncate
from hks_jax.eigen.host.shift_invert import ShiftInvert
from hks_jax.eigen.inertia import checked_pencil
from hks_jax.eigen.lanczos.block_lanczos import BlockLanczos
from hks_jax.eigen.one_pencil import Interval, checked_interval, solve_interval, solve_lowest, widened
from hks_jax.eigen.solver import Eigensolver, Report, silent
from hks_jax.fem.assembly import MassKind
from hks_jax.fem.boundary import BoundarySpec
from hks_jax.fem.elements import Quadrature
from hks_jax.fem.pencil import AnyPencil, MirrorPencil, Pencil
from hks_jax.traced import is_traced


def eigenpairs(
    domain: Any,
    k: int | None = None,
    boundary: BoundarySpec = "neumann",
    solver: str | Eigensolver = "auto",
    mass: MassKind = "consistent",
    multiplet: MultipletChoice = "report",
    throw: bool = False,
    progress: Report | None = None,
    *,
    interval: tuple[float, float] | None = None,
    quadrature: Quadrature = "gauss",
) -> Eigenpairs:
    """Compute the k lowest eigenpairs of the Laplace–Beltrami operator, or of any symmetric pencil Kφ = λMφ.

    Differentiable with respect to the tensors, the vertices, or the matrices' entries, forward and reverse, once. The
    derivatives of signatures are exact at eigenvalues of any multiplicity, those of single eigenvectors only where
    the eigenvalue is simple (docs/derivatives.md).

    Args:
        domain: a tensor field; a mesh; a pencil from `assemble` or `sparse_pencil`; or a symmetric matrix K, or a pair
            (K, M), as `sparse_pencil` takes them.
        k: how many pairs, 1 … number of degrees of freedom. With an interval it is not needed, but where values are
            traced: there it must be the number of eigenvalues in the interval (`count_eigenvalues`).
        boundary: see `assemble`; belongs to the pencil if one is given.
        solver: ``"auto"`` (by size; under `jit`, `vmap` and on accelerators never on the host), ``"dense"``,
            ``"shift-invert"`` (on the host), ``"block-lanczos"`` (2D and surfaces above all),
            ``"chebyshev-filter"`` (grids, above all 3D), or a solver with its settings, such as
            ``hks_jax.BlockLanczos(tolerance=1e-6)``. The choice made is in ``.solver_name``. Matrices and
            forms of your own that may be indefinite, and intervals, take only ``"dense"`` and ``"block-lanczos"``;
            the former, where values are concrete, ``"shift-invert"`` too. Derivatives in an interval take the tolerance
            of the solver's ``adjoint`` alone.
        mass: ``"consistent"`` or ``"lumped"``; belongs to the pencil if one is given.
        multiplet: what to do with a multiple eigenvalue that k cuts; an interval cuts none. ``"report"`` warns;
            ``"drop"`` leaves its copies out of every signature; ``"complete"`` computes 8 pairs more and takes the
            missing copies in (or drops it, if 8 are too few). What is left out is still in the arrays, and marked in
            ``.kept``.
        throw: whether a failure is an error, also under `jit`, where no warning is possible: pairs whose ``.result`` is
            not successful, and derivatives that do not converge. It takes a callback to the host. Else pairs carry the
            code and derivatives are NaN, with a warning where values are concrete.
        progress: called with short texts while it runs, where values are concrete; ``print`` will do.
        interval: (a, b): all eigenpairs with a ≤ λ < b in place of the lowest.
        quadrature: see `assemble`; belongs to the pencil if one is given.

    Returns:
        The pairs with residuals and convergence flags. λ of a null vector (a constant for each natural component) is
        exactly zero.

    Raises:
        ValueError: k out of range; an unknown solver, boundary or mass; a solver that does not take the pencil; a
            pencil whose stiffness does not annihilate what it says is its null space; a mass that is not positive
            definite; an interval that is empty, has an eigenvalue for an end, or holds more eigenpairs than fit into
            memory (how many there are).
        RuntimeError: with ``throw``, what failed.

    Warns:
        AccuracyWarning: unconverged pairs, a bound that is not confirmed, or a multiple eigenvalue that k cuts (where
            values are concrete).
    """
    pencil = checked_pencil(domain, boundary, mass, quadrature)
    if multiplet not in get_args(MultipletChoice):
        raise ValueError(f'multiplet: got {multiplet!r}; expected "report", "drop" or "complete"')
    report = progress or silent
    if interval is not None:
        pairs = _in_interval(pencil, interval, k, solver, throw, report)
    else:
        total = sum(part.size for part in pencil.parts)
        if not isinstance(k, int | float | np.number) or k != k // 1 or not 1 <= k <= total:
            raise ValueError(
                f"k: got {k}; expected an integer from 1 to {total}, the number of degrees of freedom. "
                "Use a smaller k or a finer grid, or give an interval"
            )
        pairs = _lowest(pencil, int(k), solver, multiplet, throw, report)
    gauge = pairs.eigenvalues, pairs.next_eigenvalue, pairs.kept, pairs.part, pairs.pencil
    pairs = eqx.tree_at(lambda p: p.vectors, pairs, of_simple(pairs.vectors, *gauge)).on(pencil)
    if throw:
        result = jax.lax.stop_gradient(pairs).result
        pairs = result.error_if(pairs, result != RESULTS.successful)
    known = jax.lax.stop_gradient(pairs)
    if not is_traced(known.eigenvalues):
        for message in known.messages():
            warn_of_accuracy(message)
    return pairs


def eigsh(
    K: Any,
    M: Any = None,
    k: int | None = None,
    *,
    interval: tuple[float, float] | None = None,
    solver: str | Eigensolver | None = None,
    throw: bool = False,
    progress: Report | None = None,
) -> Eigenpairs:
    """Compute the lowest eigenpairs of a sparse symmetric pencil, or all in an interval, and prove that none is missed.

    ``eigsh(K, M, k)`` is ``eigenpairs(sparse_pencil(K, M), k)``, in the spelling of `scipy.sparse.linalg.eigsh`. It
    computes what SciPy's does with ``sigma`` below the spectrum and ``which="LM"``, and needs no shift. K may be
    singular, with any null space, or indefinite. Eigenvectors are the *rows* of ``.vectors``. Multiple eigenvalues are
    found with all their copies; where values are traced, one with more than some forty may lack some, which is told.
    There is no ``which``: for the largest eigenvalues negate K, for those in the middle give the interval. There is no
    ``LinearOperator`` either: K and M are factorised, by nested dissection.

    Differentiable with respect to the entries of K and M, forward and reverse, once: exactly at any multiplicity, for
    signatures and for sums of eigenvalues over all copies. Eigenvectors have a derivative where their eigenvalue is
    simple, and else NaN: in place of Σᵢ f(λᵢ) φᵢ(x)² by hand take `spectral_signature`. Works under `jit` and, with
    one pattern, `vmap` over the entries (make the pencil with `sparse_pencil` and map over it). Pairs in an interval
    are differentiated with the interval's ends fixed.

    Args:
        K: symmetric (n, n): a SciPy sparse matrix, a BCOO or BCSR of `jax.experimental.sparse`, an operator of this
            package, a full array; or a pencil from `sparse_pencil` or `assemble`, without M.
        M: symmetric positive definite, likewise, or its diagonal (n,); None is the identity.
        k: how many, 1 … n. See `eigenpairs` for k with an interval.
        interval: (a, b): all a ≤ λ < b.
        solver: see `eigenpairs`; None is ``"auto"``.
        throw: see `eigenpairs`.
        progress: likewise.

    Returns:
        The pairs with residuals, convergence flags and the certificate. All signatures take them.

    Raises:
        ValueError: what `sparse_pencil` and `eigenpairs` refuse.
        RuntimeError: with ``throw``, what failed.

    Warns:
        AccuracyWarning: pairs that did not converge, a bound that is not confirmed, a multiple eigenvalue that k cuts.
    """
    return eigenpairs(
        K if M is None else (K, M), k, solver=solver or "auto", throw=throw, progress=progress, interval=interval
    )


def _lowest(
    pencil: AnyPencil, k: int, solver: str | Eigensolver, multiplet: MultipletChoice, throw: bool, report: Report
) -> Eigenpairs:
    total = sum(part.size for part in pencil.parts)
    size = min(k + SPARE, total) if multiplet == "complete" else k
    solvers = [choose_solver(solver, part, size) for part in pencil.parts]
    extra = min(1, total - size)  # to see where the spectrum is cut
    if isinstance(pencil, MirrorPencil):
        pairs = solve_doubled(pencil, solvers, size, extra, throw, report)
    else:
        pairs = solve_lowest(widened(pencil, solvers, size + extra).parts[0], solvers[0], size, extra, throw, report)
        found = jax.lax.stop_gradient(pairs)
        doubtful = solver == "auto" and isinstance(solvers[0], ShiftInvert) and not pencil.bounded
        if doubtful and (found.unconfirmed or not found.converged.all()):  # as where k cuts many copies
            pairs = solve_lowest(pencil, BlockLanczos(), size, extra, throw, report)
    return truncate(pairs, k, multiplet)


def _in_interval(
    pencil: AnyPencil,
    interval: tuple[float, float],
    k: int | None,
    solver: str | Eigensolver,
    throw: bool,
    report: Report,
) -> Eigenpairs:
    if len(pencil.parts) > 1 and k is not None:
        raise ValueError("k: the problems of a doubled domain are counted one by one; leave k out")
    checked = [checked_interval(part, interval, k) for part in jax.lax.stop_gradient(pencil).parts]
    solvers = [_for_interval(solver, part, each) for part, each in zip(pencil.parts, checked, strict=True)]
    traced = is_traced([each.below for each in checked])
    whole = pencil if traced else widened(pencil, solvers, max(int(each.below) + each.k for each in checked))
    problems = zip(whole.parts, checked, solvers, strict=True)
    solved = tuple(solve_interval(part, each, method, throw, report) for part, each, method in problems)
    return merge(whole, solved, sum(pairs.k for pairs in solved), 0) if isinstance(whole, MirrorPencil) else solved[0]


def _for_interval(solver: str | Eigensolver, pencil: Pencil, interval: Interval) -> BlockLanczos | Dense:
    """Return the solver for an interval: all pairs at once where the others leave no room for a basis."""
    chosen = choose_solver(solver, pencil, max(interval.k, 1))
    if solver == "auto" and not isinstance(chosen, BlockLanczos | Dense):
        chosen = BlockLanczos()
    if not isinstance(chosen, BlockLanczos | Dense):
        raise ValueError(f'solver: got {chosen.name!r}; an interval takes "block-lanczos" or "dense"')
    return chosen if interval.k + 1 <= chosen.max_pairs(pencil.size) else Dense(chosen.tolerance)
