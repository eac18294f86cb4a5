"""The lowest eigenpairs of a domain: those of its only pencil, or of all pencils of a doubled domain."""

import math
import time
from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np

from hks_jax.arrays import jax_array
from hks_jax.eigen.automatic import choose_solvers
from hks_jax.eigen.doubled import DoubledEigenpairs
from hks_jax.eigen.eigenpairs import Eigenpairs, PencilEigenpairs, require_pairs
from hks_jax.eigen.one_pencil import pairs_of_pencil
from hks_jax.eigen.solver import Dense, Eigensolver, Report, Status
from hks_jax.fem.pencil import AnyPencil, Pencil
from hks_jax.traced import is_traced


class _Problem(NamedTuple):
    """One of the problems that share the k lowest pairs of a domain."""

    pencil: Pencil
    solvers: tuple[Eigensolver, ...]
    limit: int  # the largest possible number of its pairs among the k lowest pairs of all problems
    start: PencilEigenpairs | None  # the pairs of a similar problem, to start from


def pairs_of_pencils(
    pencil: AnyPencil,
    solver: str | Eigensolver,
    k: int,
    throw: bool,
    report: Report,
    start: Eigenpairs | None,
) -> Eigenpairs:
    """Return the k lowest pairs of a pencil or, for a doubled domain, of all its problems together."""
    solvers, starts = choose_solvers(solver, pencil, k), _starts(start, pencil)
    if len(pencil.parts) > 1:
        return _of_several(pencil, solvers, starts, k, throw, report)
    return _solved(_Problem(pencil.parts[0], solvers[0], k, starts[0]), k, throw, report)


def _of_several(
    pencil: AnyPencil,
    solvers: Sequence[tuple[Eigensolver, ...]],
    starts: Sequence[PencilEigenpairs | None],
    k: int,
    throw: bool,
    report: Report,
) -> Eigenpairs:
    """Return the k lowest pairs of all problems together.

    For traced values, each problem is solved for the largest number of pairs that it can have among the k lowest. For
    concrete values, each problem is first solved for an equal share of the k pairs plus a margin, and again for twice
    as many pairs while some of its pairs may be missing.
    """
    problems = []
    for part, own, including, rows in zip(pencil.parts, solvers, pencil.including, starts, strict=True):
        limit = min(max(k // len(including), 1), part.size)
        # If the solver cannot compute `limit` pairs of a small problem, the dense solver does.
        dense = limit >= own[0].max_pairs(part.size)
        problems.append(_Problem(part, (Dense(own[0].tolerance),) if dense else own, limit, rows))
    share = k if is_traced(jax.lax.stop_gradient(pencil)) else _share(pencil, k)
    wanted = [min(each.limit, max(share, 0 if each.start is None else each.start.k)) for each in problems]
    pairs: dict[int, PencilEigenpairs] = {}
    while any(wanted):
        for i, each in enumerate(problems):
            if wanted[i]:
                pairs[i] = _solved(each, wanted[i], throw, _of_problem(report, i, wanted))
        wanted = _missing(problems, pairs, k)
    return DoubledEigenpairs.of(list(pairs.values()), k).keeping(jax_array(np.ones(k, bool)))


def _starts(start: Eigenpairs | None, pencil: AnyPencil) -> Sequence[PencilEigenpairs | None]:
    """Return the pairs from which each problem starts, as constants."""
    if start is None:
        return [None] * len(pencil.parts)
    problems = jax.lax.stop_gradient(require_pairs(start).problems)
    expected, got = ([each.space.node_shape for each in of] for of in (pencil.parts, problems))
    if got != expected:
        raise ValueError(f"start: got pairs on nodes of the shapes {got}; expected {expected}, one for each problem")
    # Where all given vectors are zero, such as on another component, a filter would keep them zero.
    others = [
        int((part.space.free != each.space.free).sum()) for part, each in zip(pencil.parts, problems, strict=True)
    ]
    if any(others):
        raise ValueError(
            f"start: got pairs of another mask or boundary condition, which differs at {max(others)} nodes; expected "
            "pairs of the same ones"
        )
    return problems


# By Weyl's law, a problem has N(λ) ≈ V λ^(3/2)/6π² ± S λ/16π eigenvalues below λ in 3D, and (A λ ± L √λ)/4π in 2D; S
# or L is the measure of its boundary. The boundary terms of all problems cancel: with the share m = k/n of each of n
# problems, the k-th eigenvalue of all is about (6π²m/V)^(2/3) or 4πm/A. There the boundary term of the even problem is
# S V^(−2/3) (6π²m)^(2/3)/16π or L √(m/4πA): for a cube 1.8 m^(2/3), for a square 1.1 √m. The margin is 2.5 times as
# large, for domains with a longer boundary.
_MARGIN = {2: 2.8, 3: 4.5}


def _share(pencil: AnyPencil, k: int) -> int:
    """Return a number of pairs that each problem rarely exceeds among the k lowest pairs of all problems."""
    d, mean = pencil.space.dimension, k / len(pencil.parts)
    return math.ceil(mean + _MARGIN[d] * mean ** (1 - 1 / d)) + 4


def _solved(problem: _Problem, k: int, throw: bool, report: Report) -> PencilEigenpairs:
    """Return the k lowest pairs of a problem, by its first solver whose result leaves no doubt, or by the last one."""
    for solver in problem.solvers:
        pairs = pairs_of_pencil(problem.pencil, solver, k, throw, report, problem.start)
        if solver is problem.solvers[-1] or not _is_doubtful(pairs):
            break
    return pairs


def _is_doubtful(pairs: PencilEigenpairs) -> bool:
    found = jax.lax.stop_gradient(pairs)
    return bool(found.unconfirmed or not found.converged.all())


def _missing(problems: list[_Problem], pairs: dict[int, PencilEigenpairs], k: int) -> list[int]:
    """Return, for each problem, the number of pairs to compute again if some of the k lowest may be missing, or 0."""
    more = [min(each.limit, 2 * pairs[i].k) if pairs[i].k < each.limit else 0 for i, each in enumerate(problems)]
    if not any(more):
        return more
    spectra = jax.lax.stop_gradient([(each.eigenvalues, each.next_eigenvalue) for each in pairs.values()])
    merged = np.sort(np.concatenate([np.append(*each) for each in spectra]))
    reach = merged[k] if merged.size > k else np.inf
    return [0 if end >= reach else number for number, (_, end) in zip(more, spectra, strict=True)]


def _of_problem(report: Report, number: int, wanted: list[int]) -> Report:
    """Return a report function that names the current problem, and assumes that each later problem takes as long."""
    of, later, begin = len(wanted), sum(n > 0 for n in wanted[number + 1 :]), time.perf_counter()

    def tell(text: str) -> None:
        left = getattr(text, "seconds_left", None)
        if left is not None:
            left += later * (time.perf_counter() - begin + left)
        report(Status(f"problem {number + 1} of {of}: {text}", left))

    return tell
