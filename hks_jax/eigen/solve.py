"""The driver: assemble, choose a solver, truncate, report."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.sparse import BCOO, BCSR
from scipy.sparse import issparse

from hks_jax.accuracy import warn_of_accuracy
from hks_jax.eigen.choice import choose_solver
from hks_jax.eigen.count import certain_count
from hks_jax.eigen.dense import Dense
from hks_jax.eigen.derivative import of_simple
from hks_jax.eigen.eigenpairs import RESULTS, Eigenpairs
from hks_jax.eigen.lanczos.block_lanczos import BlockLanczos
from hks_jax.eigen.mirror import solve_intervals, solve_mirror
from hks_jax.eigen.multiplets import SPARE, MultipletChoice, check_choice, truncate
from hks_jax.eigen.part import Interval, checked_interval, solve_interval, solve_lowest
from hks_jax.eigen.solver import Eigensolver, Report, silent
from hks_jax.fem.assembly import MassKind, assemble
from hks_jax.fem.boundary import BoundarySpec
from hks_jax.fem.pencil import MirrorPencil, Pencil
from hks_jax.fem.space import MatrixSpace
from hks_jax.fem.sparse_input import require_null_space, sparse_pencil
from hks_jax.linear.operators import DiagonalOperator, Operator, PatternedOperator, SparseOperator
from hks_jax.linear.pencil import SymmetricPencil
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
            ``hks_jax.BlockLanczos(tolerance=1e-6)``. The choice made is in ``.solver_name``. Where K may be indefinite,
            and in an interval, only ``"dense"`` and ``"block-lanczos"``; derivatives in an interval take the
            tolerance of the solver's ``adjoint`` alone.
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
    pencil = _pencil(domain, boundary, mass)
    check_choice(multiplet)
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
    gauge = pairs.eigenvalues, pairs.next_eigenvalue, pairs.kept, pairs.part, pencil
    pairs = eqx.tree_at(lambda p: p.vectors, pairs, of_simple(pairs.vectors, *gauge))
    if throw:
        result = jax.lax.stop_gradient(pairs).result
        pairs = result.error_if(pairs, result != RESULTS.successful)
    known = jax.lax.stop_gradient(pairs)
    if not is_traced(known.eigenvalues):
        for message in known.messages():
            warn_of_accuracy(message)
    return pairs


def _pencil(domain: Any, boundary: BoundarySpec, mass: MassKind) -> Pencil | MirrorPencil:
    """Return the pencil that a domain, or what a user gives in its place, stands for; checked where it is theirs."""
    matrix = issparse(domain) or isinstance(domain, BCOO | BCSR | Operator | np.ndarray | jax.Array | list)
    given = matrix or isinstance(domain, SymmetricPencil | MirrorPencil | tuple)
    if not given:
        return assemble(domain, boundary, mass)
    if boundary != "neumann" or mass != "consistent":
        raise ValueError("boundary, mass: a pencil has them already; give them to `assemble` instead")
    if matrix:
        domain = sparse_pencil(domain)
    elif isinstance(domain, tuple):
        if len(domain) != 2:
            raise ValueError(f"domain: got a tuple of {len(domain)}; expected a pair (K, M)")
        domain = sparse_pencil(*domain)
    elif not isinstance(domain, Pencil | MirrorPencil):
        domain = sparse_pencil(domain)
    if isinstance(domain, Pencil) and isinstance(domain.space, MatrixSpace):
        matrices = domain.stiffness, domain.mass
        symmetric = [m.symmetric_part() if isinstance(m, SparseOperator) else m for m in matrices]
        domain = eqx.tree_at(lambda p: (p.stiffness, p.mass), domain, symmetric)
    for part in jax.lax.stop_gradient(domain).parts:
        require_null_space(part)
        if isinstance(part.space, MatrixSpace) and not is_traced(part):
            _check_mass(part)
    return domain


def _check_mass(pencil: Pencil) -> None:
    if isinstance(pencil.mass, DiagonalOperator):
        return
    assert isinstance(pencil.mass, PatternedOperator)
    ones = DiagonalOperator(jnp.ones(pencil.size, pencil.mass.dtype))
    negative, sound = certain_count(SymmetricPencil(pencil.mass, ones), jnp.zeros((), pencil.mass.dtype))
    if int(negative) or not sound:
        what = f"{int(negative)} negative eigenvalue(s)" if sound else "an eigenvalue that is zero within rounding"
        raise ValueError(f"M: it has {what}, by the inertia of its factorisation; expected positive definite")


def _lowest(
    pencil: Pencil | MirrorPencil,
    k: int,
    solver: str | Eigensolver,
    multiplet: MultipletChoice,
    throw: bool,
    report: Report,
) -> Eigenpairs:
    total = sum(part.size for part in pencil.parts)
    size = min(k + SPARE, total) if multiplet == "complete" else k
    choices = [choose_solver(solver, part, size) for part in pencil.parts]
    name = " + ".join(dict.fromkeys(choice.name for choice in choices))
    extra = min(1, total - size)  # to see where the spectrum is cut
    if isinstance(pencil, MirrorPencil):
        pairs = solve_mirror(pencil, choices, size, extra, name, throw, report)
    else:
        pairs = solve_lowest(pencil, choices[0], size, extra, name, throw, report)
    return truncate(pairs, k, multiplet)


def _in_interval(
    pencil: Pencil | MirrorPencil,
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
    problems = zip(pencil.parts, checked, solvers, strict=True)
    solved = tuple(solve_interval(part, each, method, throw, report) for part, each, method in problems)
    return solve_intervals(pencil, solved) if isinstance(pencil, MirrorPencil) else solved[0]


def _for_interval(solver: str | Eigensolver, pencil: Pencil, interval: Interval) -> BlockLanczos | Dense:
    """Return the solver for an interval: all pairs at once where the others leave no room for a basis."""
    chosen = choose_solver(solver, pencil, max(interval.k, 1))
    if solver == "auto" and not isinstance(chosen, BlockLanczos | Dense):
        chosen = BlockLanczos()
    if not isinstance(chosen, BlockLanczos | Dense):
        raise ValueError(f'solver: got {chosen.name!r}; an interval takes "block-lanczos" or "dense"')
    return chosen if interval.k + 1 <= chosen.max_pairs(pencil.size) else Dense(chosen.tolerance)
