"""Eigenpairs of large sparse pencils by SciPy's shift-invert Lanczos, on the host."""

import time
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import ArpackError, ArpackNoConvergence, LinearOperator, eigsh
from threadpoolctl import threadpool_limits

from hks_jax.checks import require_count
from hks_jax.eigen.adjoints.complement import Adjoint
from hks_jax.eigen.quality import largest_of
from hks_jax.eigen.shift_invert.host_adjoint import HostAdjoint
from hks_jax.eigen.solver import Eigensolver, RawPairs, Report, Status, is_remote, silent
from hks_jax.fem.pencil import Pencil
from hks_jax.linear.host_matrices import factorise_on_host, host_matrices, inertia_on_host
from hks_jax.traced import is_traced

HostPairs = tuple[np.ndarray, np.ndarray, float]

_ROUNDS = 20
"""The maximal number of ARPACK runs. Each run of ARPACK after the first searches for missed eigenvalues."""
_BESIDE = 1e-6
"""The distance of a count of eigenvalues below the last computed one, relative to the range of the computed ones."""
_TOLD = 25
"""The number of solves between two reports."""


class ShiftInvert(Eigensolver[Pencil]):
    """ARPACK's Lanczos (`scipy.sparse.linalg.eigsh`) on (K + sM)⁻¹M for some s > 0, by SuperLU in float64 on the host.

    The inertia of a second factorisation checks that no eigenvalue was missed. Under `jit` and `vmap`, the solver runs
    in a host callback, one problem at a time. Outside `jit`, it can be interrupted, and reports progress.

    Attributes:
        tolerance: the relative residual at which a pair counts as converged; ARPACK itself runs to machine precision.
        max_restarts: the maximal number of implicit restarts.
        basis: the number of vectors in the Lanczos basis; None means 5k/4 + 20. The solver enlarges a basis that does
            not exceed the number of computed pairs, which for derivatives includes guard pairs.

    Examples:
        >>> sparse = hj.eigenpairs(field, k=12, solver=hj.ShiftInvert(basis=30))
        >>> np.allclose(sparse.eigenvalues, pairs.eigenvalues, atol=1e-3)
        True
    """

    name: ClassVar[str] = "shift-invert"
    in_double: ClassVar[bool] = True
    tolerance: float = eqx.field(default=1e-8, static=True)
    max_restarts: int = eqx.field(default=300, static=True)
    basis: int | None = eqx.field(default=None, static=True)
    adjoint: Adjoint = eqx.field(default=HostAdjoint(), static=True, kw_only=True)

    def max_pairs(self, n_dof: int) -> int:
        """Return n_dof − 1, because a Lanczos basis must have more than k vectors."""
        return n_dof - 1

    def __check_init__(self) -> None:
        require_count("max_restarts", self.max_restarts)
        if self.basis is not None:
            require_count("basis", self.basis, 2)

    def lowest(self, pencil: Pencil, k: int, report: Report = silent) -> RawPairs:
        """Return the k lowest eigenpairs, and the shift at which inertia confirmed that none is missing."""
        n, dtype, dimension = pencil.space.n_dof, pencil.stiffness.dtype, pencil.space.dimension
        data, matrices = host_matrices(pencil)
        null_space_known = pencil.null_space is not None
        lowest = 0.0 if null_space_known else np.nan if pencil.lower_bound is None else pencil.lower_bound

        def solve(lowest: ArrayLike, volume: ArrayLike, *data: ArrayLike) -> tuple[np.ndarray, ...]:
            (K, M), origin = matrices(*data), float(np.asarray(lowest))
            if not null_space_known:
                origin = _lower_bound(K, M) if np.isnan(origin) else origin
                K = K - origin * M
            # K + sM is positive definite for any shift s > 0. The shift is small relative to the lowest positive
            # eigenvalue by Weyl's law or, if that is unknown, relative to the median of Kᵢᵢ/Mᵢᵢ.
            if dimension is None or not np.isfinite(volume):
                shift = 1e-3 * float(np.median(K.diagonal() / M.diagonal()))
            else:
                shift = 0.1 * (2 * np.pi) ** 2 / float(np.asarray(volume)) ** (2 / dimension)
            # More BLAS threads hardly accelerate ARPACK's products with its basis, and slow them down on busy cores.
            with threadpool_limits(1, user_api="blas"):
                values, vectors, bound = self._lanczos(K, M, k, shift, report)
                if not null_space_known and is_remote(values, _rounding(K, M)):
                    spread = values[-1] - values[0]
                    nearer = values[0] - spread
                    origin, K = origin + nearer, K - nearer * M
                    values, vectors, bound = self._lanczos(K, M, k, spread, report)
            return tuple(np.asarray(result, dtype) for result in (values + origin, vectors, bound + origin))

        inputs = (lowest, jnp.inf if pencil.volume is None else pencil.volume, *data)
        if is_traced(inputs):
            shapes = tuple(jax.ShapeDtypeStruct(shape, dtype) for shape in ((k,), (k, n), ()))
            return jax.pure_callback(solve, shapes, *inputs, vmap_method="sequential")
        return jax.device_put(solve(*inputs))  # `asarray` would return NumPy arrays while JAX differentiates

    def _lanczos(self, K: csc_matrix, M: csc_matrix, k: int, shift: float, report: Report) -> HostPairs:
        n = K.shape[0]
        nothing = np.full(k, np.nan), np.full((k, n), np.nan), np.nan
        if not (np.isfinite(K.data).all() and np.isfinite(M.data).all()):
            return nothing
        report("factorising")
        begun = time.perf_counter()
        rounding = _rounding(K, M)
        factor = factorise_on_host(K + shift * M)
        factorised = time.perf_counter()
        values, vectors = np.empty(0), np.empty((n, 0))
        solves = before = 0
        wanted, basis = k, 1

        def apply_inverse(x: np.ndarray) -> np.ndarray:
            nonlocal solves
            solves += 1
            if solves % _TOLD == 0:
                to_come = expected_solves(solves - before, basis, wanted) - (solves - before)
                of_each = (time.perf_counter() - factorised) / solves
                # The final count of eigenvalues takes another factorisation.
                left = to_come * of_each + factorised - begun
                report(Status(f"{solves} of about {solves + to_come} solves", left))
            y = factor.solve(x)
            return y - vectors @ (vectors.T @ (M @ y))

        inverse = LinearOperator(K.shape, matvec=apply_inverse, dtype=np.float64)
        for seed in range(_ROUNDS):
            start = np.random.default_rng(seed).standard_normal(n)
            least, before = max(wanted + 1, self.basis or wanted + wanted // 4 + 20), solves
            for basis in (min(n, size * least) for size in (1, 2, 4)):
                try:
                    further, others = eigsh(
                        K, wanted, M, -shift, OPinv=inverse, v0=start, ncv=basis, maxiter=self.max_restarts
                    )
                    break
                except ArpackNoConvergence as stopped:
                    return _padded(stopped.eigenvalues, stopped.eigenvectors, k, np.nan) if seed == 0 else nothing
                except ArpackError:  # a high multiplicity exhausted a small basis
                    pass
            else:
                return nothing
            order = np.argsort(np.concatenate([values, further]))[:k]
            values = np.concatenate([values, further])[order]
            vectors = np.concatenate([vectors, others], axis=1)[:, order]
            # Lanczos with single vectors can miss pairs of a multiple eigenvalue. By Sylvester's law of inertia, the
            # negative pivots of K − σM count the eigenvalues below σ. If pairs are missing, search orthogonally to
            # known pairs.
            # The count is just below the last value. If all values are copies of the lowest eigenvalue, the distance is
            # just above their rounding errors; if the factorisation is too inaccurate there, the distance is larger.
            near = max(_BESIDE * (values[-1] - values[0]), 4 * rounding)
            for distance in (near, _BESIDE * max(values[-1], shift)):
                below = values[-1] - distance
                if below <= 0:  # only null vectors
                    return _padded(values, vectors, k, max(below, 0.0))
                negative, sound = inertia_on_host(K, M, below)
                if sound:
                    break
            missing = negative - int((values < below).sum())
            if not sound or missing <= 0:
                return _padded(values, vectors, k, below if sound else np.nan)
            report(f"{missing} eigenpairs are missing: searching again")
            wanted = min(missing + 2, n - 1)
        return nothing


# ARPACK orthogonalises each new vector against the whole basis, which takes more time than the solves if k is large. A
# basis of 5k/4 + 20 vectors takes as many solves as one of 2k + 20 or fewer, and a sixth less time; for k = 350, a
# third less. At a restart, ARPACK keeps the converged vectors and half of the remaining basis; each restart takes a few
# additional solves. On planar domains, ARPACK takes about 9k/4 + 30 solves; on cubes with multiple eigenvalues, up to
# 1.7 times as many.
def expected_solves(done: int, basis: int, wanted: int) -> int:
    """Return the expected total number of solves: as many as usual, or if these are done, until the next restart."""
    restart = (basis - wanted) // 2 + 4
    beyond = max(done, 9 * wanted // 4 + 30) - basis
    return basis + max(1, -(-beyond // restart)) * restart


def _padded(values: np.ndarray, vectors: np.ndarray, k: int, complete_below: float) -> HostPairs:
    order, missing = np.argsort(values), k - values.size
    return (
        np.pad(values[order], (0, missing), constant_values=np.nan),
        np.pad(vectors[:, order].T, [(0, missing), (0, 0)], constant_values=np.nan),
        complete_below,
    )


def _rounding(K: csc_matrix, M: csc_matrix) -> float:
    """Return the distance at which two eigenvalues are equal within rounding."""
    return 4 * np.finfo(float).eps * float(largest_of(np, K, M))


def _lower_bound(K: csc_matrix, M: csc_matrix) -> float:
    """Return a lower bound of the spectrum, confirmed by inertia; NaN if the search fails."""
    typical = float(np.median(np.abs(K.diagonal()) / M.diagonal())) or 1.0
    shifts = -1e-3 * typical * 4.0 ** np.arange(25)
    return next((shift for shift in shifts if inertia_on_host(K, M, shift) == (0, True)), np.nan)
