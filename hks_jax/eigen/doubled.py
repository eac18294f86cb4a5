"""Eigenpairs of a doubled domain: the problems of its parts are solved, and their spectra are merged."""

import math
import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.arrays import jax_array
from hks_jax.eigen.eigenpairs import Eigenpairs
from hks_jax.eigen.one_pencil import solve_lowest, widened
from hks_jax.eigen.rotations import with_rotations
from hks_jax.eigen.solver import Dense, Eigensolver, Report, Status
from hks_jax.fem.pencil import MirrorPencil
from hks_jax.traced import is_traced


def solve_doubled(
    pencil: MirrorPencil, solvers: list[Eigensolver], k: int, extra: int, throw: bool, report: Report
) -> Eigenpairs:
    """Return the k lowest pairs of a doubled domain, from the problems of its parts; ``extra`` = 1 adds one eigenvalue.

    For traced values, each part's problem is solved for the largest number of pairs that this part can have among the k
    lowest (`_limits`). For concrete values, each part's problem is first solved for an equal share of the k pairs plus
    a margin, and again for twice as many pairs while some of its pairs may be missing. The margin is about 2√k, because
    by Weyl's law boundary conditions change the number of a part's pairs among the k lowest by about √k.
    """
    parts, total = pencil.parts, k + extra
    whole, limits = widened(pencil, solvers, total), _limits(pencil, total)
    traced = is_traced(jax.lax.stop_gradient(pencil))
    share = math.ceil(total / len(parts)) + 2 * math.isqrt(total) + 4
    wanted = limits if traced else [min(limit, share) for limit in limits]
    # All pairs of a small part may be needed, and an iterative solver cannot compute all pairs.
    solvers = [
        solver if limit <= solver.max_pairs(part.size) else Dense(solver.tolerance)
        for solver, part, limit in zip(solvers, parts, limits, strict=True)
    ]

    def solve(number: int, report: Report) -> Eigenpairs:
        return solve_lowest(whole.parts[number], solvers[number], wanted[number], 0, throw, report)

    solved = [solve(i, _of_problem(report, i, len(parts))) for i in range(len(parts))]
    while not traced:
        spectra = [np.asarray(jax.lax.stop_gradient(pairs.eigenvalues)) for pairs in solved]
        merged = np.sort(np.concatenate(spectra))
        reach = merged[total - 1] if merged.size >= total else np.inf
        short = [i for i, spectrum in enumerate(spectra) if wanted[i] < limits[i] and not spectrum[-1] >= reach]
        if not short:
            break
        for i in short:
            wanted[i] = min(limits[i], 2 * wanted[i])
            solved[i] = solve(i, report)
    assert isinstance(whole, MirrorPencil)
    return merge(whole, tuple(solved), k, extra)


def _limits(pencil: MirrorPencil, total: int) -> list[int]:
    """Return, for each part, the largest possible number of its pairs among the ``total`` lowest pairs of all parts."""
    shares = zip(pencil.including, pencil.parts, strict=True)
    return [min(max(total // len(including), 1), part.size) for including, part in shares]


def _of_problem(report: Report, number: int, of: int) -> Report:
    """Return a report function that names the current problem, and assumes that each later problem takes as long."""
    begin = time.perf_counter()

    def tell(text: str) -> None:
        left = getattr(text, "seconds_left", None)
        if left is not None:
            left += (of - 1 - number) * (time.perf_counter() - begin + left)
        report(Status(f"problem {number + 1} of {of}: {text}", left))

    return tell


@partial(jax.jit, static_argnames=("k", "extra"))
def merge(pencil: MirrorPencil, solved: tuple[Eigenpairs, ...], k: int, extra: int) -> Eigenpairs:
    """Merge the pairs of all parts, and return the k lowest; with ``extra`` = 1, also return the next eigenvalue."""
    values, sizes = jnp.concatenate([pairs.eigenvalues for pairs in solved]), [pairs.k for pairs in solved]
    order = jnp.argsort(jnp.concatenate(_sorted_by(pencil, solved)))
    lowest, ends = order[:k], np.cumsum(sizes)[:-1]
    chosen = jnp.split(jnp.zeros(values.size, bool).at[lowest].set(True), ends)
    frames = [  # a chosen vector also rotates towards computed vectors that are not chosen
        with_rotations(p.frame, jax.lax.stop_gradient(p.eigenvalues), c[:, None] & ~c[None], None, p.pencil)
        for p, c in zip(solved, chosen, strict=True)
    ]
    rows = [p.space.transfer(own, pencil.space) for p, own in zip(solved, frames, strict=True)]

    return Eigenpairs(
        eigenvalues=values[lowest],
        residuals=jnp.concatenate([pairs.residuals for pairs in solved])[lowest],
        converged=jnp.concatenate([pairs.converged for pairs in solved])[lowest],
        rounding=jnp.concatenate([pairs.rounding for pairs in solved])[lowest],
        kept=jnp.ones(k, bool),
        next_eigenvalue=jax.lax.stop_gradient(values[order[k]]) if extra else jnp.asarray(jnp.inf, values.dtype),
        complete_below=_complete_below(pencil, solved, values[order[k + extra - 1 :][:1]], k + extra),
        spectral_origin=solved[0].spectral_origin,
        multiplet_tolerance=jnp.max(jnp.stack([pairs.multiplet_tolerance for pairs in solved])),
        part=jax_array(np.repeat(np.arange(len(solved)), sizes))[lowest],
        # An eigenfunction has norm 1 on the domain doubled m times, hence norm 1/√2ᵐ on the domain itself.
        frame=jnp.concatenate(rows)[lowest] / math.sqrt(len(solved)),
        pencil=pencil,
        solver_name=" + ".join(dict.fromkeys(pairs.solver_name for pairs in solved)),
    )


# If the trial functions of part B include those of part A, the j-th eigenvalue of part A is not below the j-th
# eigenvalue of part B. If the j-th eigenvalues of both parts are equal, rounding may exchange their order, so that part
# A could have more of the lowest eigenvalues of the doubled domain than `MirrorPencil.including` allows.
def _sorted_by(pencil: MirrorPencil, solved: tuple[Eigenpairs, ...]) -> list[Float[Array, " _"]]:
    """Return sort keys: the maximum of a part's j-th eigenvalue and those of all parts that include this part."""
    keys: list[Array] = []
    for pairs, including in zip(solved, pencil.including, strict=True):
        own = pairs.eigenvalues
        for j in including[:-1]:
            both = min(len(own), len(keys[j]))
            own = own.at[:both].max(keys[j][:both])
        keys.append(own)
    return keys


def _complete_below(
    pencil: MirrorPencil, solved: tuple[Eigenpairs, ...], reach: Float[Array, " 1"], total: int
) -> Float[Array, ""]:
    """Return the bound below which no eigenvalue of the doubled domain is missing.

    A part's solver may certify completeness only below the part's last computed eigenvalue. But a part with as many
    pairs as `_limits` allows has no further eigenvalue below ``reach``, the last of the ``total`` lowest eigenvalues.
    """
    bounds = []
    for pairs, limit in zip(solved, _limits(pencil, total), strict=True):
        bound = pairs.complete_below
        if pairs.k < pairs.space.n_dof:
            last = pairs.eigenvalues[-1]
            beyond = jnp.maximum(last, reach[0]) if pairs.k >= limit else last
            bound = jnp.where(bound >= last, beyond, bound)
        bounds.append(bound)
    return jnp.min(jnp.stack(bounds))
