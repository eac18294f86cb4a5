"""The driver: `eigenpairs` assembles matrices, and truncates the spectrum of their lowest pairs."""

from typing import Any, get_args

import jax
import numpy as np

from hks_jax.accuracy import warn_of_accuracy
from hks_jax.checks import require_static
from hks_jax.eigen.all_pencils import pairs_of_pencils
from hks_jax.eigen.eigenpairs import RESULTS, Eigenpairs
from hks_jax.eigen.multiplets import TO_COMPLETE, MultipletChoice
from hks_jax.eigen.solver import Eigensolver, Report, silent
from hks_jax.fem.assembly import MassKind
from hks_jax.fem.boundary import BoundarySpec
from hks_jax.fem.elements import Quadrature
from hks_jax.fem.sparse_input import pencil_of
from hks_jax.traced import is_traced


def eigenpairs(
    domain: Any,
    k: int,
    boundary: BoundarySpec = "neumann",
    solver: str | Eigensolver = "auto",
    mass: MassKind = "consistent",
    multiplet: MultipletChoice = "report",
    throw: bool = False,
    progress: Report | None = None,
    *,
    quadrature: Quadrature = "gauss",
    start: Eigenpairs | None = None,
) -> Eigenpairs:
    """Compute the k lowest eigenpairs of the Laplace–Beltrami operator, or of any symmetric pencil Kφ = λMφ.

    The first derivatives with respect to the tensors, the vertices, or the matrices' entries are available in forward
    and reverse mode. Derivatives of signatures are exact at eigenvalues of any multiplicity. A single eigenvector has a
    derivative only if its eigenvalue is simple (docs/derivatives.md).

    Args:
        domain: a tensor field; a mesh; a pencil from `assemble` or `sparse_pencil`; a symmetric matrix K; or a pair
            (K, M). `sparse_pencil` describes the accepted matrices.
        k: the number of pairs, from 1 to the number of degrees of freedom. `count_eigenvalues` gives the k of all
            eigenvalues below a number.
        boundary: the boundary condition of a field or mesh; see `assemble`.
        solver: ``"auto"`` (a choice by size; for accelerators, stored programs and several devices never a solver on
            the host), ``"dense"``, ``"shift-invert"`` (on the host), ``"block-lanczos"`` (mainly for 2D and surfaces),
            ``"chebyshev-filter"`` (for grids, mainly in 3D), or a solver object such as
            ``hks_jax.BlockLanczos(tolerance=1e-6)``. The result names the solver in ``.solver_name``. The Chebyshev
            filter needs a stiffness that is not indefinite.
        mass: the mass matrix of a field or mesh, ``"consistent"`` or ``"lumped"``.
        multiplet: the treatment of a multiple eigenvalue that k cuts, so that only some of its pairs are among the k
            lowest. ``"report"`` warns. ``"drop"`` excludes its pairs from every signature. ``"complete"`` computes 8
            more pairs and includes the missing pairs, or drops the eigenvalue if 8 pairs are too few. ``.kept`` marks
            the included pairs.
        throw: whether to raise an error if ``.result`` is not successful or derivatives do not converge; under `jit`, a
            callback to the host raises the error. Without ``throw``, ``.result`` has the error's code, derivatives that
            did not converge are NaN, and concrete values cause a warning.
        progress: a function such as ``print`` that receives short texts during a computation with concrete values.
        quadrature: the quadrature rule for a field or mesh; see `assemble`.
        start: pairs of similar tensors on the same nodes, with the same k and boundary condition, from which
            ``hks_jax.ChebyshevFilter(keep_spare=True)`` starts, if it also computed them. They are constants in
            derivatives; other solvers ignore them.

    Returns:
        The pairs with residuals and convergence flags. The eigenvalue of a null vector is exactly zero. (Each component
        without Dirichlet nodes has a constant null vector.)

    Raises:
        ValueError: k is out of range; the solver, boundary or mass is unknown; the solver does not support the pencil;
            the stiffness does not annihilate the given null vectors; the mass is not positive definite; ``start`` has
            other nodes or another number of problems.
        RuntimeError: the computation failed and ``throw`` is set.

    Warns:
        AccuracyWarning: values are concrete, and some pairs did not converge, the solver could not confirm that it
            missed no eigenvalue, k cuts a multiple eigenvalue, or float32 does not distinguish an eigenvalue from zero.

    Examples:
        >>> flat = hj.TensorField(field.grid, np.tile(np.eye(2), (9, 9, 1, 1)))
        >>> print((hj.eigenpairs(flat, k=4).eigenvalues / jnp.pi**2).round(1))  # m² + n² on the unit square
        [0. 1. 1. 2.]
    """
    require_static("k", k)
    if multiplet not in get_args(MultipletChoice):
        raise ValueError(f'multiplet: got {multiplet!r}; expected "report", "drop" or "complete"')
    pencil = pencil_of(domain, boundary, mass, quadrature)
    total = sum(part.size for part in pencil.parts)
    number = np.asarray(k)
    real = number.ndim == 0 and number.dtype.kind in "iuf"
    if not real or number != number // 1 or not 1 <= number <= total:
        remedy = ". Use a smaller k or a finer grid" * bool(real and number > total)
        raise ValueError(f"k: got {k}; expected an integer from 1 to {total}, the number of degrees of freedom{remedy}")
    k = int(number)
    size = min(k + TO_COMPLETE, total) if multiplet == "complete" else k
    pairs = pairs_of_pencils(pencil, solver, size, throw, progress or silent, start).truncated(k, multiplet)
    found = jax.lax.stop_gradient(pairs)
    if is_traced(found.eigenvalues):
        return found.result.error_if(pairs, found.result != RESULTS.successful) if throw else pairs
    if throw and found.result != RESULTS.successful:
        codes: Any = RESULTS  # mypy sees its members as strings
        raise RuntimeError(codes[found.result])
    for message in found.messages():
        warn_of_accuracy(message)
    return pairs


def eigsh(
    K: Any,
    M: Any = None,
    k: int = 6,
    *,
    solver: str | Eigensolver | None = None,
    throw: bool = False,
    progress: Report | None = None,
) -> Eigenpairs:
    """Compute the k lowest eigenpairs of a sparse symmetric pencil, and certify that none is missing.

    ``eigsh(K, M, k)`` equals ``eigenpairs(sparse_pencil(K, M), k)``. The function corresponds to
    `scipy.sparse.linalg.eigsh` with ``which="LM"`` and ``sigma`` below the spectrum, but needs no shift. K may be
    singular, with any null space, or indefinite. Eigenvectors are the *rows* of ``.vectors``. Multiple eigenvalues are
    found with their full multiplicity. If values are traced, an eigenvalue of multiplicity above about forty may lack
    pairs; then ``.result`` is not successful. For the largest eigenvalues, negate K. For all eigenvalues below b, take
    the k that `count_eigenvalues` returns. A ``LinearOperator`` is not accepted, because K and M are factorised (by
    nested dissection).

    Derivatives with respect to the entries of K and M are those of `eigenpairs`. The derivative of an eigenvector is
    NaN if its eigenvalue is multiple; so do not sum f(λᵢ) φᵢ(x)² yourself, but use `spectral_signature`. The function
    works under `jit`, and under `vmap` over pencils from `sparse_pencil` that share a sparsity pattern.

    Args:
        K: a symmetric (n, n) matrix: a SciPy sparse matrix, a BCOO or BCSR of `jax.experimental.sparse`, an operator of
            this package, or a dense array. Without M, K may also be a pencil from `sparse_pencil` or `assemble`.
        M: a symmetric positive definite matrix of one of these types, or its diagonal (n,); None means the identity.
        k: the number of pairs, from 1 to n; by default 6, as SciPy's.
        solver: see `eigenpairs`; None means ``"auto"``.
        throw: see `eigenpairs`.
        progress: see `eigenpairs`.

    Returns:
        The pairs, which all signatures accept, with residuals, convergence flags and the certificate.

    Raises:
        ValueError: `sparse_pencil` or `eigenpairs` does not accept an argument.
        RuntimeError: the computation failed and ``throw`` is set.

    Warns:
        AccuracyWarning: see `eigenpairs`.

    Examples:
        >>> K = 2 * np.eye(5) - np.eye(5, k=1) - np.eye(5, k=-1)  # five masses between springs
        >>> print(hj.eigsh(K, k=3).eigenvalues.round(3))  # 2 − 2 cos(jπ/6)
        [0.268 1. 2. ]
    """
    return eigenpairs(K if M is None else (K, M), k, solver=solver or "auto", throw=throw, progress=progress)
