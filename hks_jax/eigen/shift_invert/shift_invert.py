"""Eigenpairs of sparse pencils by shift-invert block Lanczos on the host."""

import time
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from scipy.linalg import eigh
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import SuperLU
from threadpoolctl import threadpool_limits

from hks_jax.checks import require_count
from hks_jax.eigen.adjoints.complement import Adjoint
from hks_jax.eigen.quality import largest_of
from hks_jax.eigen.shift_invert.host_adjoint import HostAdjoint
from hks_jax.eigen.shift_invert.host_lanczos import nearest
from hks_jax.eigen.solver import Eigensolver, RawPairs, Report, Status, is_remote, silent
from hks_jax.eigen.weyl import weyl
from hks_jax.fem.pencil import Pencil
from hks_jax.linear.host_matrices import factorise_on_host, host_matrices, inertia, inertia_on_host
from hks_jax.linear.multifrontal import CONTRACTION
from hks_jax.traced import is_traced

HostPairs = tuple[np.ndarray, np.ndarray, float]

_BLOCK, _MANY = 4, 200
"""The number of vectors per block for few pairs, and the number of pairs from which on blocks are twice as wide."""
_BESIDE = 1e-6
"""The distance of a count of eigenvalues below the last computed one, relative to the range of the computed ones."""
_LEAST_SHIFT = 1e-6
"""The least distance of a shift below the spectrum, relative to the median of K's diagonal divided by that of M."""
_TOLD = 25
"""The least number of solves between two reports."""
_FEW = 12
"""The largest number of eigenvalues for which a shift below the spectrum is as fast as one within, so none is tried."""
_TRIES = 3
"""The maximal number of shifts that are tried within the spectrum."""
_POOR = 1e-9
"""The residual, relative to the eigenvalue or the first positive one, up to which a vector needs no further solve."""
_ACCURATE = 1e-9
"""The largest convergence rate of iterative refinement with a factorisation within the spectrum."""


class ShiftInvert(Eigensolver[Pencil]):
    """Block Lanczos on (K − σM)⁻¹M with SuperLU's factorisation, in float64 on the host, without compilation.

    For more than 12 pairs, the shift σ is about half of the k-th eigenvalue; otherwise, and if no such shift is found,
    it is below the spectrum. The inertia of a second factorisation checks that no eigenvalue was missed. Under `jit`
    and `vmap`, the solver runs in a host callback, one problem at a time. Outside `jit`, it can be interrupted, and
    reports progress.

    Attributes:
        tolerance: the relative residual at which a pair counts as converged; Lanczos itself runs until 1e-12.
        max_restarts: the maximal number of searches after the first: for missing copies of multiple eigenvalues, and
            for further pairs if the basis is full.
        basis: the maximal number of vectors in the Lanczos basis. If None, it is 4k + 160, and doubles after a search
            that found too few pairs. Most searches use about 2k vectors.

    Examples:
        >>> sparse = hj.eigenpairs(field, k=12, solver=hj.ShiftInvert(basis=60))
        >>> np.allclose(sparse.eigenvalues, pairs.eigenvalues, atol=1e-3)
        True
    """

    name: ClassVar[str] = "shift-invert"
    in_double: ClassVar[bool] = True
    tolerance: float = eqx.field(default=1e-8, static=True)
    max_restarts: int = eqx.field(default=20, static=True)
    basis: int | None = eqx.field(default=None, static=True)
    adjoint: Adjoint = eqx.field(default=HostAdjoint(), static=True, kw_only=True)

    def max_pairs(self, n_dof: int) -> int:
        """Return n_dof − 1: with all pairs, no eigenvalue would be left for the certificate."""
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
            scales = _scales(K, M, k, dimension, float(np.asarray(volume)))
            # More BLAS threads hardly accelerate products with the basis, and slow them down on busy cores.
            with threadpool_limits(1, user_api="blas"):
                values, vectors, bound = self._searched(K, M, k, scales, report)
                if not null_space_known and is_remote(values, _rounding(K, M)):
                    # The distance from the spectrum is its spread, but large enough for an accurate factorisation.
                    distance = max(values[-1] - values[0], _BESIDE * values[0])
                    nearer = values[0] - distance
                    scales = scales._replace(below=distance, within=1.5 * distance)
                    again = self._searched(K - nearer * M, M, k, scales, report)
                    if np.isfinite(again[2]):
                        (values, vectors, bound), origin = again, origin + nearer
            return tuple(np.asarray(result, dtype) for result in (values + origin, vectors, bound + origin))

        inputs = (lowest, jnp.inf if pencil.volume is None else pencil.volume, *data)
        if is_traced(inputs):
            shapes = tuple(jax.ShapeDtypeStruct(shape, dtype) for shape in ((k,), (k, n), ()))
            return jax.pure_callback(solve, shapes, *inputs, vmap_method="sequential")
        return jax.device_put(solve(*inputs))  # `asarray` would return NumPy arrays while JAX differentiates

    def _searched(self, K: csc_matrix, M: csc_matrix, k: int, scales: "_Scales", report: Report) -> HostPairs:
        n = K.shape[0]
        values, vectors = np.empty(0), np.empty((n, 0))
        nothing = np.full(k, np.nan), np.full((k, n), np.nan), np.nan
        if not (np.isfinite(K.data).all() and np.isfinite(M.data).all()):
            return nothing
        report("factorising")
        begun, solves, told = time.perf_counter(), 0, 0
        rounding, mass = _rounding(K, M), M.tocsr()
        shift, factor = _shifted(K, M, k, scales)
        factorised = time.perf_counter()
        block = _BLOCK if k < _MANY else 2 * _BLOCK
        usual = int(1.75 * k + 13 * block) if shift > 0 else int(2.3 * k + 16 * block)
        missing = k

        def inverse(x: np.ndarray) -> np.ndarray:
            nonlocal solves, told
            if solves // _TOLD > told:
                told = solves // _TOLD
                expected = max(usual, solves + 2 * block)
                # The final count of eigenvalues takes another factorisation.
                left = (expected - solves) * (time.perf_counter() - factorised) / solves + factorised - begun
                report(Status(f"{solves} of about {expected} solves", left))
            solves += x.shape[1]
            return factor.solve(x)

        room = self.basis or 4 * k + 40 * block
        for seed in range(self.max_restarts + 1):
            expected = int(usual * missing / k) + 2 * block
            # Between 0 and the shift, all eigenvalues are wanted; in later searches, all up to the k-th one.
            count, radius = k - values.size, max(shift, values[-1] - shift if values.size == k else 0.0)
            try:
                with np.errstate(all="ignore"):
                    further, others = nearest(inverse, mass, shift, vectors, count, radius, block, expected, room, seed)
            except np.linalg.LinAlgError:  # overflow
                return nothing
            if not further.size and (self.basis or room >= n - values.size):
                return nothing
            order = np.argsort(np.concatenate([values, further]))[:k]
            values = np.concatenate([values, further])[order]
            vectors = np.concatenate([vectors, others], axis=1)[:, order]
            if values.size < k:
                # Many more eigenvalues than usual are near the shift.
                missing, room = k - values.size, self.basis or 2 * room
                continue
            # Lanczos can miss copies of a multiple eigenvalue. By Sylvester's law of inertia, the negative pivots of
            # K − σM count the eigenvalues below σ. If pairs are missing, search orthogonally to known pairs.
            # The count is just below the last value, beyond its rounding errors; if the factorisation is too inaccurate
            # there, further below. A few eigenvalues far below the others do not enlarge the first distance.
            spread, margin = (max(_BESIDE * (values[-1] - low), 4 * rounding) for low in (np.median(values), values[0]))
            for distance in dict.fromkeys((spread, margin, max(30 * margin, _BESIDE * max(values[-1], scales.below)))):
                below = values[-1] - distance
                if below <= 0:  # only null vectors
                    return _ordered(values, vectors, 0.0)
                negative, sound = inertia_on_host(K, M, below)
                if sound:
                    break
            missing = negative - int((values < below).sum())
            if not sound or missing <= 0:
                values, vectors = _refined(K, M, scales.below, rounding, vectors)
                return _ordered(values, vectors, below if sound and missing == 0 else np.nan)
            report(f"{missing} eigenpairs are missing: searching again")
        return nothing


class _Scales(NamedTuple):
    """Estimates from which shifts are chosen."""

    below: float  # the distance of a shift below the spectrum, relative to which the lowest eigenvalues are not small
    within: float  # half of the k-th eigenvalue
    dimension: int  # the dimension d in Weyl's law, by which the j-th eigenvalue grows like j^(2/d)


def _scales(K: csc_matrix, M: csc_matrix, k: int, dimension: int | None, volume: float) -> _Scales:
    quotients = np.abs(K.diagonal() / M.diagonal())
    median = float(np.median(quotients[quotients > 0])) if (quotients > 0).any() else 1.0
    if dimension is not None and np.isfinite(volume):
        # Beside a smaller shift, rounding would matter: nodes where diffusion is slow make nearly all of the volume.
        below = max(0.1 * (2 * np.pi) ** 2 / volume ** (2 / dimension), _LEAST_SHIFT * median)
        return _Scales(below, weyl(k, volume, dimension) / 2, dimension)
    # On a uniform grid in 2D, the k-th of n eigenvalues is about 2k/n times the median.
    return _Scales(1e-3 * median, median * k / K.shape[0], 2)


# With a shift σ within the wanted eigenvalues, the basis has about 7/4 k vectors; with one below the spectrum, where
# K − σM is positive definite, it has 9/4 k.
def _shifted(K: csc_matrix, M: csc_matrix, k: int, scales: _Scales) -> tuple[float, SuperLU]:
    """Return a shift σ near half of the k-th eigenvalue or, if there is no accurate one, below the spectrum."""
    shift, wanted = scales.within, k / 2 ** (scales.dimension / 2)
    for _ in range(_TRIES if k > _FEW and shift > 0 else 0):
        factor, number, rate = inertia(K, M, shift)
        if factor is not None and rate < _ACCURATE and k / 8 <= number <= 3 * k / 4:
            return shift, factor
        if rate < CONTRACTION:
            shift *= np.clip((wanted / max(number, 0.5)) ** (2 / scales.dimension), 1 / 16, 16)
        shift *= 1.01  # beside an eigenvalue
    return -scales.below, factorise_on_host(K + scales.below * M)


# If an eigenvalue is near the shift σ, solutions consist mostly of its eigenvector, and their rounding errors are large
# relative to the other components. These errors have high frequencies, so that residuals may be large relative to low
# eigenvalues. A solve with K + sM divides an error along φₗ by (λₗ + s)/(λᵢ + s). Rayleigh quotients are accurate in
# any case, because errors of eigenvectors enter them squared.
def _refined(
    K: csc_matrix, M: csc_matrix, s: float, rounding: float, vectors: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return eigenvalues, and the M-orthonormal eigenvectors after a further solve for those with large residuals."""
    force, image = K @ vectors, M @ vectors
    values = np.sum(vectors * force, axis=0)
    residuals, sizes = np.linalg.norm(force - image * values, axis=0), np.abs(values)
    first = sizes[sizes > rounding].min(initial=sizes.max() / sizes.size)
    large = residuals > _POOR * np.maximum(sizes, first) * np.linalg.norm(image, axis=0)
    if large.any():
        better = factorise_on_host(K + s * M).solve(image[:, large]) * (values[large] + s)
        better -= vectors[:, ~large] @ (image[:, ~large].T @ better)
        values[large], mix = eigh(better.T @ (K @ better), better.T @ (M @ better))
        vectors[:, large] = better @ mix
    return values, vectors


def _ordered(values: np.ndarray, vectors: np.ndarray, complete_below: float) -> HostPairs:
    order = np.argsort(values)
    return values[order], vectors[:, order].T, complete_below


def _rounding(K: csc_matrix, M: csc_matrix) -> float:
    """Return the distance at which two eigenvalues are equal within rounding."""
    return 4 * np.finfo(float).eps * float(largest_of(K, M))


def _lower_bound(K: csc_matrix, M: csc_matrix) -> float:
    """Return a lower bound of the spectrum, confirmed by inertia; NaN if the search fails."""
    typical = float(np.median(np.abs(K.diagonal()) / M.diagonal())) or 1.0
    shifts = -1e-3 * typical * 4.0 ** np.arange(25)
    return next((shift for shift in shifts if inertia_on_host(K, M, shift) == (0, True)), np.nan)
