"""Eigenpairs of sparse matrices, for those who come from SciPy."""

from typing import Any

from hks_jax.eigen.eigenpairs import Eigenpairs
from hks_jax.eigen.solve import eigenpairs
from hks_jax.eigen.solver import Eigensolver, Report


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
    found with all their copies. A lowest eigenvalue with more than some forty copies may lack some, which is told.
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
        throw: whether a failure is an error, also under `jit`; else the pairs carry a code, ``.result``, and it is
            warned of where values are concrete.
        progress: called with short texts, where values are concrete; ``print`` will do.

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
