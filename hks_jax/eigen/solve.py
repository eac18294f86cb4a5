"""The driver: choose a solver, treat the zero modes, measure residuals, put mirror problems together."""

import math
import warnings
from collections.abc import Callable
from functools import partial
from typing import NoReturn

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.accuracy import AccuracyWarning
from hks_jax.domain.surface_mesh import SurfaceMesh
from hks_jax.domain.tensor_field import TensorField
from hks_jax.eigen.dense import Dense
from hks_jax.eigen.eigenpairs import Eigenpairs
from hks_jax.eigen.shift_invert import ShiftInvert
from hks_jax.eigen.solver import Eigensolver, RawPairs
from hks_jax.fem.assembly import MassKind, assemble
from hks_jax.fem.boundary import BoundarySpec
from hks_jax.fem.pencil import MirrorPencil, Pencil

SOLVERS: dict[str, Callable[[], Eigensolver]] = {Dense.name: Dense, ShiftInvert.name: ShiftInvert}


def eigenpairs(
    domain: TensorField | SurfaceMesh | Pencil | MirrorPencil,
    k: int,
    boundary: BoundarySpec = "neumann",
    solver: str | Eigensolver = "auto",
    mass: MassKind = "consistent",
) -> Eigenpairs:
    """Compute the k lowest eigenpairs of the Laplace–Beltrami operator.

    Args:
        domain: a tensor field, a surface mesh, or a pencil from `assemble`.
        k: how many pairs, 1 … number of degrees of freedom.
        boundary: see `assemble`; belongs to the pencil if one is given.
        solver: ``"auto"`` (by size), ``"dense"``, ``"shift-invert"``, or a solver with its settings, such as
            ``hks_jax.ShiftInvert(progress=print)``. The choice made is in ``.solver_name``.
        mass: ``"consistent"`` or ``"lumped"``; belongs to the pencil if one is given.

    Returns:
        The pairs with residuals and convergence flags. λ of a constant (one per natural component) is exactly zero.

    Raises:
        ValueError: k out of range, an unknown solver, boundary or mass.

    Warns:
        AccuracyWarning: unconverged pairs, or a multiple eigenvalue that k cuts (where values are concrete).
    """
    if isinstance(domain, Pencil | MirrorPencil):
        if boundary != "neumann" or mass != "consistent":
            raise ValueError("boundary, mass: a pencil has them already; give them to `assemble` instead")
        pencil = domain
    else:
        pencil = assemble(domain, boundary, mass)
    total = sum(part.space.n_dof for part in pencil.parts)
    if not isinstance(k, int | float | np.number) or k != k // 1 or not 1 <= k <= total:
        raise ValueError(
            f"k: got {k}; expected an integer from 1 to {total}, the number of degrees of freedom. "
            "Use a smaller k or a finer grid"
        )
    choices = [choose_solver(solver, part, int(k)) for part in pencil.parts]
    name = " + ".join(dict.fromkeys(choice.name for choice in choices))
    if isinstance(pencil, MirrorPencil):
        pairs = _united(pencil, choices, int(k), name)
    else:
        pairs = _first(_solve_part(pencil, choices[0], min(int(k) + 1, total), name), int(k))
    if not isinstance(pairs.eigenvalues, jax.core.Tracer):
        for message in pairs.messages():
            warnings.warn(message, AccuracyWarning, stacklevel=2)
    return pairs


def choose_solver(solver: str | Eigensolver, pencil: Pencil, k: int) -> Eigensolver:
    """Return the solver that a name stands for; ``"auto"`` chooses by the pencil's size and k."""
    if isinstance(solver, Eigensolver):
        return solver
    if solver == "auto":
        # Dense costs n³ whatever k is; a Lanczos basis of twice k vectors needs room in n.
        n = pencil.space.n_dof
        return Dense() if n <= 1500 or 4 * k > n else ShiftInvert()
    if solver not in SOLVERS:
        raise ValueError(
            f'solver: got {solver!r}; expected "auto", {", ".join(f"{name!r}" for name in SOLVERS)} or a solver object'
        )
    return SOLVERS[solver]()


def _solve_part(pencil: Pencil, solver: Eigensolver, k: int, name: str) -> Eigenpairs:
    """Return k pairs of one pencil."""
    n_dof = pencil.space.n_dof
    if k > solver.max_pairs(n_dof):
        raise ValueError(
            f"k: the {solver.name} solver gives at most {solver.max_pairs(n_dof)} of {n_dof} pairs, and {k} are needed "
            "(one beyond k, to see where the spectrum is cut). Use a smaller k or the dense solver"
        )
    values, vectors = _lowest(solver, pencil, k)
    return _finish(pencil, values, vectors, solver.tolerance, name)


@partial(jax.custom_jvp, nondiff_argnums=(0, 2))
def _lowest(solver: Eigensolver, pencil: Pencil, k: int) -> RawPairs:
    return solver.lowest(pencil, k)


@_lowest.defjvp
def _lowest_jvp(solver: Eigensolver, k: int, primals: tuple, tangents: tuple) -> NoReturn:
    # Differentiating eigenvectors one by one gives NaN where eigenvalues repeat, and an answer that is wrong by many
    # per cent where only k of them are known. An error is better than either.
    raise NotImplementedError(
        "eigenpairs: derivatives with respect to the tensors, the vertices or the pencil are not implemented. "
        "Derivatives with respect to times, and of what `assemble` returns, are: compute the eigenpairs outside of the "
        "function that you differentiate, or stop the gradient at its tensors (jax.lax.stop_gradient)"
    )


def _finish_impl(
    pencil: Pencil,
    values: Float[Array, " k"],
    vectors: Float[Array, "k n_dof"],
    tolerance: float,
    name: str,
) -> Eigenpairs:
    K, M, dtype = pencil.stiffness, pencil.mass, values.dtype
    n_null = min(pencil.space.n_null, values.size)
    # The stiffness annihilates the constants exactly, so their eigenvalue is 0 and not the ±1e-13 of a solver. Put
    # the exact vectors in place of the computed ones, and take what rounding left of them out of the others.
    labels = pencil.space.null_labels
    constants = jnp.asarray(labels == np.arange(n_null)[:, None], dtype)
    constants /= jnp.sqrt(jnp.sum(constants * M.apply(constants), axis=1, keepdims=True))
    rest = vectors[n_null:]
    rest = rest - jnp.matmul(jnp.matmul(M.apply(rest), constants.T, precision="highest"), constants)
    rest /= jnp.sqrt(jnp.sum(rest * M.apply(rest), axis=1, keepdims=True))
    values = jnp.concatenate([jnp.zeros(n_null, dtype), values[n_null:]])
    vectors = jnp.concatenate([constants, rest])

    m_vectors = M.apply(vectors)
    defect = jnp.linalg.norm(K.apply(vectors) - values[:, None] * m_vectors, axis=1)
    scale = jnp.maximum(jnp.abs(values), jnp.abs(values[min(n_null, values.size - 1)]))
    scale = jnp.where(scale > 0, scale, 1)
    residuals = defect / jnp.linalg.norm(m_vectors, axis=1) / scale
    # Rounding in Kφ alone leaves eps·λ_max; 4·max(Kᵢᵢ/Mᵢᵢ) is λ_max on a uniform grid in 2D and 3D. It excuses a
    # residual of a per cent at most: beyond that, the pair is not known, whatever the reason.
    rounding = 4 * jnp.finfo(dtype).eps * 4 * jnp.max(K.diagonal() / M.diagonal()) / scale
    converged = (residuals <= jnp.maximum(tolerance, jnp.minimum(rounding, 0.01))) & (values >= 0)
    return Eigenpairs(
        values,
        vectors,
        residuals,
        converged,
        next_eigenvalue=jnp.asarray(jnp.inf, dtype),
        multiplet_tolerance=jnp.clip(rounding[-1], 1e-6, 1e-3),
        pencil=pencil,
        solver_name=name,
    )


_finish = jax.jit(_finish_impl, static_argnames=("tolerance", "name"))


def _first(pairs: Eigenpairs, k: int) -> Eigenpairs:
    """Keep the first k pairs and remember the eigenvalue after them."""
    following = pairs.eigenvalues[k] if pairs.k > k else pairs.next_eigenvalue
    return Eigenpairs(
        pairs.eigenvalues[:k],
        pairs.vectors[:k],
        pairs.residuals[:k],
        pairs.converged[:k],
        following,
        pairs.multiplet_tolerance,
        pairs.pencil,
        pairs.solver_name,
    )


def _united(pencil: MirrorPencil, solvers: list[Eigensolver], k: int, name: str) -> Eigenpairs:
    """Solve the mixed problems and merge their spectra.

    How many of the k lowest come from each part is not known beforehand. Where values are concrete, ask for a fair
    share with a margin and double it wherever the merged spectrum could still miss a pair; traced, ask every part for
    k + 1.
    """
    parts = pencil.parts
    limits = [min(k + 1, part.space.n_dof) for part in parts]
    share = math.ceil(k / len(parts)) + 2 * math.isqrt(k) + 4
    traced = any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(pencil))
    wanted = limits if traced else [min(limit, share) for limit in limits]
    # A part may be so small that all of its pairs are needed, which an iterative solver cannot give.
    solvers = [
        solver if limit <= solver.max_pairs(part.space.n_dof) else Dense(solver.tolerance)
        for solver, part, limit in zip(solvers, parts, limits, strict=True)
    ]
    solved = [_solve_part(*job, name) for job in zip(parts, solvers, wanted, strict=True)]
    while not traced:
        merged = np.sort(np.concatenate([np.asarray(pairs.eigenvalues) for pairs in solved]))
        reach = merged[k] if merged.size > k else np.inf
        short = [
            i
            for i, pairs in enumerate(solved)
            if wanted[i] < limits[i] and (merged.size <= k or float(pairs.eigenvalues[-1]) < reach)
        ]
        if not short:
            break
        for i in short:
            wanted[i] = min(limits[i], 2 * wanted[i])
            solved[i] = _solve_part(parts[i], solvers[i], wanted[i], name)
    return _merge(pencil, tuple(solved), k, name)


def _merge(pencil: MirrorPencil, solved: tuple[Eigenpairs, ...], k: int, name: str) -> Eigenpairs:
    values = jnp.concatenate([pairs.eigenvalues for pairs in solved])
    order = jnp.argsort(values)
    kept = order[:k]
    # An eigenfunction of the reflected domain has unit norm there, hence 1/√2^m of it here.
    vectors = jnp.concatenate(
        [pencil.space.restrict(pairs.space.extend(pairs.vectors, outside=0.0)) for pairs in solved]
    ) / math.sqrt(len(solved))
    return Eigenpairs(
        values[kept],
        vectors[kept],
        jnp.concatenate([pairs.residuals for pairs in solved])[kept],
        jnp.concatenate([pairs.converged for pairs in solved])[kept],
        values[order[k]] if values.size > k else jnp.asarray(jnp.inf, values.dtype),
        jnp.max(jnp.stack([pairs.multiplet_tolerance for pairs in solved])),
        pencil,
        name,
    )
