"""Eigenpairs of any sparse symmetric pencil: the lowest, or all in an interval."""

import os
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from hks_jax.accuracy import warn_of_accuracy
from hks_jax.checks import require_count
from hks_jax.eigen.count import certain_count, count_eigenvalues
from hks_jax.eigen.dense import Dense
from hks_jax.eigen.derivative import lowest
from hks_jax.eigen.eigenpairs import RESULTS, result_of
from hks_jax.eigen.interval import in_interval
from hks_jax.eigen.lanczos.block_lanczos import SLICE, BlockLanczos
from hks_jax.eigen.located import locate, translated
from hks_jax.eigen.messages import messages
from hks_jax.eigen.quality import quality
from hks_jax.eigen.solver import Eigensolver, Report, silent
from hks_jax.linear.operators import DiagonalOperator, PatternedOperator
from hks_jax.linear.pencil import SymmetricPencil
from hks_jax.linear.sparse_input import sparse_pencil
from hks_jax.traced import is_traced

_DENSE = 1000
"""Rows up to which all eigenpairs at once are faster."""
_CUT = 1e-6
"""The gap, relative to the whole spread, below which two eigenvalues count as one."""


class MatrixEigenpairs(eqx.Module):
    """Eigenpairs of Kφ = λMφ, ascending; a pytree.

    Attributes:
        eigenvalues: (k,) ascending.
        vectors: (k, n) rows, φᵢᵀMφⱼ = δᵢⱼ.
        frame: (k, n) the same numbers, of which only the derivative differs: it leaves out rotations among the k.
        residuals: (k,) ‖Kφ − λMφ‖ / ‖Mφ‖, relative to the distance of λ from the lowest eigenvalue (of an interval,
            from its lower end), at least to the mean distance of eigenvalues.
        converged: (k,) whether the residual meets the solver's tolerance, or what rounding allows if that is more.
        complete_below: every eigenvalue below it (and above the interval's lower end) is among the k, or beyond them,
            by Sylvester's law of inertia; NaN where nothing is certain.
        pencil: the matrices.
        solver_name: the method.
    """

    eigenvalues: Float[Array, " k"]
    vectors: Float[Array, "k n"]
    frame: Float[Array, "k n"]
    residuals: Float[Array, " k"]
    converged: Bool[Array, " k"]
    complete_below: Float[Array, ""]
    pencil: SymmetricPencil
    solver_name: str = eqx.field(static=True)

    @property
    def k(self) -> int:
        """The number of pairs."""
        return self.eigenvalues.shape[-1]

    @property
    def unconfirmed(self) -> Bool[Array, ""]:
        """Whether the certificate ends before the last eigenvalue."""
        return ~(self.complete_below >= self.eigenvalues[-1]) if self.k else jnp.zeros((), bool)

    @property
    def result(self) -> RESULTS:
        """What came of it, as a traced code: compare with ``RESULTS.successful``, or call its ``error_if``."""
        return result_of(self.pencil, self.converged, self.unconfirmed)


def eigsh(
    K: Any,
    M: Any = None,
    k: int | None = None,
    *,
    interval: tuple[float, float] | None = None,
    solver: BlockLanczos | None = None,
    throw: bool = False,
    progress: Report | None = None,
) -> MatrixEigenpairs:
    """Compute the lowest eigenpairs of a sparse symmetric pencil, or all in an interval, and prove that none is missed.

    Who knows `scipy.sparse.linalg.eigsh`: this computes what ``eigsh(K, k, M, sigma=…, which="LM")`` does with a shift
    below the spectrum, and needs no shift. K may be singular, with any null space, or indefinite. Eigenvectors are the
    *rows* of ``.vectors``. Multiple eigenvalues are found with all their copies (where these are more than some forty,
    pairs may be missing, which is told), and k that cuts one is said. There is no ``which``: for the largest
    eigenvalues negate K, for those in the middle give the interval. There is no ``LinearOperator`` either: K and M are
    factorised, by nested dissection.

    Differentiable with respect to the entries of K and M, forward and reverse, once: exactly at any multiplicity, for
    what does not depend on the basis within a multiple eigenvalue. Works under `jit` and, with one pattern, `vmap` over
    the entries (make the pencil with `sparse_pencil` and map over it). Pairs in an interval are differentiated with the
    interval's ends fixed.

    Args:
        K: symmetric (n, n): a SciPy sparse matrix, a BCOO or BCSR of `jax.experimental.sparse`, an operator of this
            package, a full array; or a pencil from `sparse_pencil` or `assemble`, without M.
        M: symmetric positive definite, likewise, or its diagonal (n,); None is the identity.
        k: how many, 1 … n. With an interval it is not needed, but where values are traced: there it must be the number
            of eigenvalues in the interval (`count_eigenvalues`).
        interval: (a, b): all a ≤ λ < b.
        solver: `BlockLanczos` with other settings; None takes its defaults, and for small matrices all pairs at once.
            Of its ``adjoint``, derivatives in an interval take the tolerance alone.
        throw: whether a failure is an error, also under `jit`; else the pairs carry a code, ``.result``, and it is
            warned of where values are concrete.
        progress: called with short texts after each slice, where values are concrete; ``print`` will do.

    Returns:
        The pairs with residuals, convergence flags and the certificate.

    Raises:
        ValueError: what `sparse_pencil` refuses; M that is not positive definite; k out of range; an interval that is
            empty, has an eigenvalue for an end, or holds more eigenpairs than fit into memory (how many there are).
        RuntimeError: with ``throw``, what failed.

    Warns:
        AccuracyWarning: pairs that did not converge, a bound that is not confirmed, a multiple eigenvalue that k cuts.
    """
    pencil = sparse_pencil(K, M)
    if not is_traced(jax.lax.stop_gradient(pencil)):
        _check_mass(pencil)
    if interval is not None:
        held = _checked_interval(jax.lax.stop_gradient(pencil), interval, k)
        pairs = _in_interval(pencil, *held, solver, throw, progress or silent)
        following = jnp.asarray(jnp.inf, pairs.eigenvalues.dtype)
    elif k is None:
        raise ValueError("k: not given; expected the number of eigenpairs, or an interval")
    else:
        _check_k(k, pencil.size)
        pairs, following = _lowest(pencil, int(k), solver, throw, progress or silent)
    if throw:
        result = jax.lax.stop_gradient(pairs).result
        pairs = result.error_if(pairs, result != RESULTS.successful)
    _report(*jax.lax.stop_gradient((pairs, following)))
    return pairs


def _lowest(
    pencil: SymmetricPencil, k: int, solver: BlockLanczos | None, throw: bool, report: Report
) -> tuple[MatrixEigenpairs, Float[Array, ""]]:
    """Return the k lowest pairs, and the eigenvalue that follows them."""
    n, method = pencil.size, _method(solver, k, pencil.size)
    origin, moved, number = jnp.zeros((), pencil.stiffness.dtype), pencil, k
    if isinstance(method, BlockLanczos):
        half = max(method.plan(k).slice_size // 2, 1)
        origin, first, below = locate(jax.lax.stop_gradient(pencil), half, method.block)
        if not is_traced(below):
            # Of a lowest eigenvalue with more copies than are asked for, all are computed: the count is of all.
            number = max(k, int(below)) if below > 2 * half else k
            method = _method(solver, number, n)
        spacing = (first - origin) / jnp.maximum(below, 1).astype(origin.dtype)
        moved = translated(pencil, origin, jnp.zeros((), int), first - origin, spacing)
    extra = min(1, n - number)
    values, vectors, frame, following, bound = lowest(method, moved, number, extra, throw, report)
    pairs = _pairs(pencil, moved, origin, values[:k], vectors[:k], frame[:k], bound, method)
    return pairs, (values[k] if number > k else following) + origin


def _in_interval(
    pencil: SymmetricPencil,
    low: Float[Array, ""],
    high: Float[Array, ""],
    below: Int[Array, ""],
    k: int,
    solver: BlockLanczos | None,
    throw: bool,
    report: Report,
) -> MatrixEigenpairs:
    """Return the k pairs between two numbers, below the first of which lie so many eigenvalues."""
    method = _method(solver, k, pencil.size)
    moved = translated(pencil, low, below, (high - low) / (2 * max(k / SLICE, 1)), (high - low) / max(k, 1))
    if k == 0:
        values, vectors, bound = jnp.zeros(0, low.dtype), jnp.zeros((0, pencil.size), low.dtype), high - low
        return _pairs(pencil, moved, low, values, vectors, vectors, bound, method)
    values, vectors, frame, bound = in_interval(method, moved, k, throw, report)
    return _pairs(pencil, moved, low, values, vectors, frame, jnp.minimum(bound, high - low), method)


def _pairs(
    pencil: SymmetricPencil,
    moved: SymmetricPencil,
    origin: Float[Array, ""],
    values: Float[Array, " k"],
    vectors: Float[Array, "k n"],
    frame: Float[Array, "k n"],
    bound: Float[Array, ""],
    method: Eigensolver,
) -> MatrixEigenpairs:
    """Return the pairs of a pencil that are those of the one moved to the origin."""
    residuals, converged = jnp.zeros_like(values), jnp.ones(values.shape, bool)
    if len(values):
        held = jax.lax.stop_gradient((moved, values, vectors))
        unit = (held[1][-1] - held[1][0]) / len(values)
        residuals, converged, _ = quality(*held, unit, method.tolerance)
    return MatrixEigenpairs(
        values + origin, vectors, frame, residuals, converged, bound + origin, pencil, solver_name=method.name
    )


def _method(solver: BlockLanczos | None, k: int, n: int) -> BlockLanczos | Dense:
    method = solver or BlockLanczos()
    small = n <= _DENSE and solver is None
    return Dense(method.tolerance) if small or k + 1 > method.max_pairs(n) else method


def _check_mass(pencil: SymmetricPencil) -> None:
    if isinstance(pencil.mass, DiagonalOperator):
        return
    assert isinstance(pencil.mass, PatternedOperator)
    ones = DiagonalOperator(jnp.ones(pencil.size, pencil.mass.dtype))
    negative, sound = certain_count(SymmetricPencil(pencil.mass, ones), jnp.zeros((), pencil.mass.dtype))
    if int(negative) or not sound:
        what = f"{int(negative)} negative eigenvalue(s)" if sound else "an eigenvalue that is zero within rounding"
        raise ValueError(f"M: it has {what}, by the inertia of its factorisation; expected positive definite")


def _check_k(k: Any, n: int) -> None:
    require_count("k", k)
    if k > n:
        raise ValueError(f"k: got {k}; expected at most {n}, the number of rows")


def _checked_interval(
    pencil: SymmetricPencil, interval: tuple[float, float], k: int | None
) -> tuple[Float[Array, ""], Float[Array, ""], Int[Array, ""], int]:
    """Return the ends, how many eigenvalues lie below the first, and how many between them."""
    low, high = (jnp.asarray(end, pencil.stiffness.dtype) for end in interval)
    if is_traced(jax.lax.stop_gradient((pencil, low, high))):
        if k is None:
            raise ValueError(
                "k: not given, and values are traced; expected the number of eigenvalues in the interval, which must "
                "be known beforehand: `count_eigenvalues` at both ends, outside jax.jit"
            )
        _check_k(k, pencil.size)
        return low, high, certain_count(pencil, low)[0], int(k)
    if not float(low) < float(high):
        raise ValueError(f"interval: got ({float(low):g}, {float(high):g}); expected (a, b) with a < b, both finite")
    try:
        below, above = (count_eigenvalues(pencil, end) for end in (low, high))
    except ValueError as error:
        raise ValueError(f"interval: {str(error).removeprefix('below: ')}") from None
    count = int(above - below)
    if k is not None and k != count:
        raise ValueError(f"k: got {k}; there are {count} eigenvalues in the interval. Leave k out")
    needed, available = (
        4 * count * pencil.size * low.dtype.itemsize,
        os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"),
    )
    if needed > available:
        raise ValueError(
            f"interval: it holds {count} eigenpairs, which need about {needed / 1e9:.3g} GB, and the machine has "
            f"{available / 1e9:.3g} GB; divide the interval"
        )
    return low, high, below, count


def _report(pairs: MatrixEigenpairs, following: Float[Array, ""]) -> None:
    """Warn of what limits the pairs, where values are concrete."""
    if is_traced(pairs.eigenvalues) or not pairs.k:
        return
    values = np.asarray(pairs.eigenvalues)
    gap = _CUT * max(values[-1] - values[0], abs(values[-1]) * float(np.finfo(values.dtype).eps))
    cut = int(np.sum(values >= values[-1] - gap)) if float(following) - values[-1] <= gap else 0
    for message in messages(pairs, pairs.k, cut, "a solver with other settings"):
        warn_of_accuracy(message)
