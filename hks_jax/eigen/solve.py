"""The driver: assemble, choose a solver, truncate, report."""

import jax
import numpy as np

from hks_jax.accuracy import warn_of_accuracy
from hks_jax.domain.simplicial_mesh import SimplicialMesh
from hks_jax.domain.tensor_field import TensorField
from hks_jax.eigen.choice import choose_solver
from hks_jax.eigen.eigenpairs import RESULTS, Eigenpairs
from hks_jax.eigen.mirror import solve_mirror
from hks_jax.eigen.multiplets import SPARE, MultipletChoice, check_choice, truncate
from hks_jax.eigen.part import solve_part
from hks_jax.eigen.solver import Eigensolver, Report, silent
from hks_jax.fem.assembly import MassKind, assemble
from hks_jax.fem.boundary import BoundarySpec
from hks_jax.fem.pencil import MirrorPencil, Pencil
from hks_jax.traced import is_traced


def eigenpairs(
    domain: TensorField | SimplicialMesh | Pencil | MirrorPencil,
    k: int,
    boundary: BoundarySpec = "neumann",
    solver: str | Eigensolver = "auto",
    mass: MassKind = "consistent",
    multiplet: MultipletChoice = "report",
    throw: bool = False,
    progress: Report | None = None,
) -> Eigenpairs:
    """Compute the k lowest eigenpairs of the Laplace–Beltrami operator.

    Differentiable with respect to the tensors, the vertices, or the pencil's entries, forward and reverse, once. The
    derivatives of signatures are exact at eigenvalues of any multiplicity, those of single eigenvectors only where
    the eigenvalue is simple (docs/derivatives.md).

    Args:
        domain: a tensor field, a mesh, or a pencil from `assemble` (one whose stiffness annihilates the
            constants of natural components, and so must its perturbations).
        k: how many pairs, 1 … number of degrees of freedom.
        boundary: see `assemble`; belongs to the pencil if one is given.
        solver: ``"auto"`` (by size; under `jit`, `vmap` and on accelerators never on the host), ``"dense"``,
            ``"shift-invert"`` (on the host), ``"block-lanczos"`` (2D and surfaces above all),
            ``"chebyshev-filter"`` (grids, above all 3D), or a solver with its settings, such as
            ``hks_jax.BlockLanczos(tolerance=1e-6)``. The choice made is in ``.solver_name``.
        mass: ``"consistent"`` or ``"lumped"``; belongs to the pencil if one is given.
        multiplet: what to do with a multiple eigenvalue that k cuts. ``"report"`` warns; ``"drop"`` leaves its copies
            out of every signature; ``"complete"`` computes 8 pairs more and takes the missing copies in (or drops
            it, if 8 are too few). What is left out is still in the arrays, and marked in ``.kept``.
        throw: whether a failure is an error, also under `jit`, where no warning is possible: pairs whose ``.result`` is
            not successful, and derivatives that do not converge. It takes a callback to the host. Else pairs carry the
            code and derivatives are NaN, with a warning where values are concrete.
        progress: called with short texts while it runs, where values are concrete; ``print`` will do.

    Returns:
        The pairs with residuals and convergence flags. λ of a constant (one per natural component) is exactly zero.

    Raises:
        ValueError: k out of range, an unknown solver, boundary or mass.
        RuntimeError: with ``throw``, what failed.

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
    check_choice(multiplet)
    k = int(k)
    size = min(k + SPARE, total) if multiplet == "complete" else k
    choices = [choose_solver(solver, part, size) for part in pencil.parts]
    name = " + ".join(dict.fromkeys(choice.name for choice in choices))
    extra = min(1, total - size)  # to see where the spectrum is cut
    if isinstance(pencil, MirrorPencil):
        pairs = solve_mirror(pencil, choices, size, extra, name, throw, progress or silent)
    else:
        pairs = solve_part(pencil, choices[0], size, extra, name, throw, progress or silent)
    pairs = truncate(pairs, k, multiplet)
    if throw:
        result = jax.lax.stop_gradient(pairs).result
        pairs = result.error_if(pairs, result != RESULTS.successful)
    known = jax.lax.stop_gradient(pairs)
    if not is_traced(known.eigenvalues):
        for message in known.messages():
            warn_of_accuracy(message)
    return pairs
