"""The problems of a doubled domain, reflected or glued along its rim, their spectra merged into one."""

import math
import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.eigen.dense import Dense
from hks_jax.eigen.derivative import frame_within
from hks_jax.eigen.eigenpairs import Eigenpairs
from hks_jax.eigen.part import solve_lowest
from hks_jax.eigen.solver import Eigensolver, Report, Status
from hks_jax.eigen.weyl import weyl, weyl_number
from hks_jax.fem.pencil import MirrorPencil
from hks_jax.traced import is_traced


def solve_mirror(
    pencil: MirrorPencil, solvers: list[Eigensolver], k: int, extra: int, name: str, throw: bool, report: Report
) -> Eigenpairs:
    """Solve the mixed problems and return the k lowest pairs of all, and with one ``extra`` the next eigenvalue.

    How many come from each part is not known beforehand. Where values are concrete, ask for what Weyl's law says, with
    a margin, and double it wherever the merged spectrum could still miss a pair; traced, ask every part for all.
    """
    parts, total = pencil.parts, k + extra
    limits = [min(total, part.space.n_dof) for part in parts]
    traced = is_traced(jax.lax.stop_gradient(pencil))
    wanted = (
        limits if traced else [min(limit, share) for limit, share in zip(limits, _shares(pencil, total), strict=True)]
    )
    # A part may be so small that all of its pairs are needed, which an iterative solver cannot give.
    solvers = [
        solver if limit <= solver.max_pairs(part.space.n_dof) else Dense(solver.tolerance)
        for solver, part, limit in zip(solvers, parts, limits, strict=True)
    ]
    problems = zip(parts, solvers, wanted, strict=True)
    solved = [
        solve_lowest(part, solver, size, 0, name, throw, _of_problem(report, number, len(parts)))
        for number, (part, solver, size) in enumerate(problems)
    ]
    while not traced:
        spectra = [np.asarray(jax.lax.stop_gradient(pairs.eigenvalues)) for pairs in solved]
        merged = np.sort(np.concatenate(spectra))
        reach = merged[total - 1] if merged.size >= total else np.inf
        short = [
            i
            for i, spectrum in enumerate(spectra)
            if wanted[i] < limits[i] and (merged.size < total or spectrum[-1] < reach)
        ]
        if not short:
            break
        for i in short:
            wanted[i] = min(limits[i], 2 * wanted[i])
            solved[i] = solve_lowest(parts[i], solvers[i], wanted[i], 0, name, throw, report)
    return _merge(pencil, tuple(solved), k, extra, name)


def solve_intervals(pencil: MirrorPencil, solved: tuple[Eigenpairs, ...]) -> Eigenpairs:
    """Return the pairs in an interval of all problems."""
    name = " + ".join(dict.fromkeys(pairs.solver_name for pairs in solved))
    return _merge(pencil, solved, sum(pairs.k for pairs in solved), 0, name)


def _of_problem(report: Report, number: int, of: int) -> Report:
    """Return what tells which problem is being solved; those to come are taken to last as long as this one."""
    begin = time.perf_counter()

    def tell(text: str) -> None:
        left = getattr(text, "seconds_left", None)
        if left is not None:
            left += (of - 1 - number) * (time.perf_counter() - begin + left)
        report(Status(f"problem {number + 1} of {of}: {text}", left))

    return tell


# In units of the spacing a part's volume is its number of nodes, and a rim of r nodes that is Dirichlet and not natural
# changes the rim's length or area by −2r.
def _shares(pencil: MirrorPencil, total: int) -> list[int]:
    """Return about how many of the lowest pairs come from each part, and some more."""
    d, sizes = pencil.space.dimension, [part.space.n_dof for part in pencil.parts]
    mean = sum(sizes) / len(sizes)
    share, margin = total / len(sizes), 2 * math.isqrt(total) + 4
    value = weyl(share, mean, d)
    return [max(math.ceil(share + weyl_number(value, 0.0, d, 2 * (size - mean))), 0) + margin for size in sizes]


@partial(jax.jit, static_argnames=("k", "extra", "name"))
def _merge(pencil: MirrorPencil, solved: tuple[Eigenpairs, ...], k: int, extra: int, name: str) -> Eigenpairs:
    values = jnp.concatenate([pairs.eigenvalues for pairs in solved])
    order = jnp.argsort(values)
    lowest = order[:k]
    # An eigenfunction of the doubled domain has unit norm there, hence 1/√2^m of it here.
    vectors = jnp.concatenate(
        [pencil.space.restrict(pairs.space.extend(pairs.vectors, outside=0.0)) for pairs in solved]
    ) / math.sqrt(len(solved))
    vectors, part = vectors[lowest], jnp.asarray(np.repeat(np.arange(len(solved)), [p.k for p in solved]))[lowest]
    return Eigenpairs(
        values[lowest],
        vectors,
        frame_within(vectors, pencil, part),
        jnp.concatenate([pairs.residuals for pairs in solved])[lowest],
        jnp.concatenate([pairs.converged for pairs in solved])[lowest],
        kept=jnp.ones(lowest.shape, bool),
        part=part,
        next_eigenvalue=jax.lax.stop_gradient(values[order[k]]) if extra else jnp.asarray(jnp.inf, values.dtype),
        complete_below=jnp.min(jnp.stack([_complete_below(pairs) for pairs in solved])),
        spectral_origin=solved[0].spectral_origin,
        multiplet_tolerance=jnp.max(jnp.stack([pairs.multiplet_tolerance for pairs in solved])),
        pencil=pencil,
        solver_name=name,
        lowest=solved[0].lowest,
    )


def _complete_below(pairs: Eigenpairs) -> Float[Array, ""]:
    """Return the bound below which a part's pairs are complete: of those beyond its last, nothing is known here."""
    if pairs.k == pairs.space.n_dof or not pairs.lowest:
        return pairs.complete_below
    return jnp.minimum(pairs.complete_below, pairs.eigenvalues[-1])
