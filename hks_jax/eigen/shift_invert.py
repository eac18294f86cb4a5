"""Large sparse pencils by SciPy's shift-invert Lanczos on the host."""

import warnings
from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.sparse import coo_matrix, csc_matrix, diags
from scipy.sparse.linalg import ArpackError, ArpackNoConvergence, LinearOperator, SuperLU, eigsh, splu

from hks_jax.accuracy import AccuracyWarning
from hks_jax.eigen.complement import solve_complement
from hks_jax.eigen.solver import Eigensolver, RawPairs
from hks_jax.fem.operators import Pattern
from hks_jax.fem.pencil import Pencil

_ROUNDS = 20
"""How often to look for missed copies of a multiple eigenvalue; each round finds at least one."""


class ShiftInvert(Eigensolver):
    """ARPACK's Lanczos (`scipy.sparse.linalg.eigsh`) on (K + sM)⁻¹M, factorised by SuperLU; float64 on the host.

    That no eigenvalue below the last was missed is checked by the inertia of a second factorisation. Under `jit` and
    `vmap` it runs through a host callback, one problem at a time; called plainly it can be interrupted, and reports
    progress.

    Attributes:
        tolerance: relative residual that counts as converged; ARPACK itself runs to machine precision.
        max_restarts: implicit restarts before giving up.
        basis: size of the Lanczos basis, more than k (for derivatives, than 9 + k + k/20); None takes 2k + 20.
        derivative_tolerance: to what the linear solves for derivatives reduce their error, in the energy norm; not
            below what the eigenvectors' dtype allows.
        progress: called with short texts such as ``"150 solves"`` while it runs; None is silent.
    """

    name: ClassVar[str] = "shift-invert"
    tolerance: float = eqx.field(default=1e-8, static=True)
    max_restarts: int = eqx.field(default=300, static=True)
    basis: int | None = eqx.field(default=None, static=True)
    derivative_tolerance: float = eqx.field(default=1e-12, static=True)
    progress: Callable[[str], None] | None = eqx.field(default=None, static=True)

    def max_pairs(self, n_dof: int) -> int:
        """Return n_dof − 1: a Lanczos basis must be larger than what is wanted."""
        return n_dof - 1

    def __check_init__(self) -> None:
        """Check the settings."""
        if not 0 < self.derivative_tolerance < 1:
            raise ValueError(f"derivative_tolerance: got {self.derivative_tolerance}; expected between 0 and 1")
        if self.max_restarts < 1 or (self.basis is not None and self.basis < 2):
            raise ValueError(
                f"max_restarts, basis: got {self.max_restarts}, {self.basis}; expected at least 1, at least 2 or None"
            )

    def lowest(self, pencil: Pencil, k: int) -> RawPairs:
        """Return the k lowest eigenpairs."""
        n, dtype, dimension = pencil.space.n_dof, pencil.stiffness.dtype, pencil.space.dimension
        (data_k, data_m), matrices = _host_matrices(pencil)

        def solve(data_k: np.ndarray, data_m: np.ndarray, volume: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            # The shift keeps K + sM positive definite; Weyl's λ₁ is the scale on which it is small.
            shift = 0.1 * (2 * np.pi) ** 2 / float(volume) ** (2 / dimension)
            K, M = matrices(data_k, data_m)
            values, vectors = self._lanczos(K, M, k, shift)
            return values.astype(dtype), vectors.astype(dtype)

        inputs = (data_k, data_m, pencil.volume)
        if not any(isinstance(x, jax.core.Tracer) for x in inputs):
            values, vectors = solve(*map(np.asarray, inputs))
            return jnp.asarray(values), jnp.asarray(vectors)
        shapes = (jax.ShapeDtypeStruct((k,), dtype), jax.ShapeDtypeStruct((k, n), dtype))
        return jax.pure_callback(solve, shapes, *inputs, vmap_method="sequential")

    def solve_complement(
        self,
        pencil: Pencil,
        values: Float[Array, " p"],
        vectors: Float[Array, "p n_dof"],
        rhs: Float[Array, "k n_dof"],
    ) -> Float[Array, "k n_dof"]:
        """Solve (K − λᵢM) xᵢ = (I − MΦΦᵀ) rhsᵢ with ΦᵀMxᵢ = 0; see `hks_jax.eigen.complement`."""
        data, matrices = _host_matrices(pencil)
        # What rounded eigenvectors leave to be solved beyond their own accuracy is noise.
        tolerance = max(self.derivative_tolerance, 100 * float(jnp.finfo(rhs.dtype).eps))

        def solve(data_k: np.ndarray, data_m: np.ndarray, *arrays: np.ndarray) -> np.ndarray:
            values, vectors, b = (np.asarray(array, np.float64) for array in arrays)
            if not all(np.isfinite(array).all() for array in (values, vectors, b)):
                warnings.warn(
                    f"derivative: {int(np.isnan(values).sum())} of the {values.size} eigenpairs that it needs (guards "
                    "beyond k included) did not converge, and it is NaN. Allow more restarts, or a larger basis",
                    AccuracyWarning,
                    stacklevel=2,
                )
                return np.full(rhs.shape, np.nan, rhs.dtype)
            K, M = matrices(data_k, data_m)
            x, errors = solve_complement(
                K,
                M,
                values,
                vectors,
                b,
                factorise=_factorise,
                tolerance=tolerance,
                report=self._report,
            )
            failed = ~(errors <= 1)
            if failed.any():
                warnings.warn(
                    f"derivative: the linear solves for {int(failed.sum())} of {failed.size} eigenpairs did not "
                    f"converge, and their part is NaN. k may cut a cluster of eigenvalues: take another k, or set "
                    "multiplet='drop' in `eigenpairs`",
                    AccuracyWarning,
                    stacklevel=2,
                )
                x[failed] = np.nan
            self._report(f"derivative: error {np.max(errors, initial=0.0) * tolerance:.1e}")
            return x.astype(rhs.dtype)

        shape = jax.ShapeDtypeStruct(rhs.shape, rhs.dtype)
        return jax.pure_callback(solve, shape, *data, values, vectors, rhs, vmap_method="sequential")

    def _lanczos(self, K: csc_matrix, M: csc_matrix, k: int, shift: float) -> tuple[np.ndarray, np.ndarray]:
        n = K.shape[0]
        nothing = np.full(k, np.nan), np.full((k, n), np.nan)
        if not (np.isfinite(K.data).all() and np.isfinite(M.data).all()):
            return nothing
        self._report("factorising")
        factor = _factorise(K + shift * M)
        values, vectors = np.empty(0), np.empty((n, 0))
        solves, wanted = 0, k

        def apply_inverse(x: np.ndarray) -> np.ndarray:
            nonlocal solves
            solves += 1
            if solves % 50 == 0:
                self._report(f"{solves} solves")
            y = factor.solve(x)
            return y - vectors @ (vectors.T @ (M @ y))

        inverse = LinearOperator(K.shape, matvec=apply_inverse, dtype=np.float64)
        for seed in range(_ROUNDS):
            start = np.random.default_rng(seed).standard_normal(n)
            basis = min(n, max(wanted + 1, self.basis or 2 * wanted + 20))
            try:
                more, found = eigsh(K, wanted, M, -shift, OPinv=inverse, v0=start, ncv=basis, maxiter=self.max_restarts)
            except ArpackNoConvergence as stopped:
                return _padded(stopped.eigenvalues, stopped.eigenvectors, k) if seed == 0 else nothing
            except ArpackError:
                return nothing
            order = np.argsort(np.concatenate([values, more]))[:k]
            values = np.concatenate([values, more])[order]
            vectors = np.concatenate([vectors, found], axis=1)[:, order]
            # Lanczos with single vectors can miss copies of a multiple eigenvalue. By Sylvester's law of inertia the
            # negative pivots of K − σM count the eigenvalues below σ: look again, past what is found, for the missing.
            below = values[-1] - 1e-6 * max(values[-1], shift)
            if below <= 0:  # nothing but constants
                return _padded(values, vectors, k)
            missing = int((_factorise(K - below * M).U.diagonal() < 0).sum()) - int((values < below).sum())
            if missing <= 0:
                return _padded(values, vectors, k)
            self._report(f"{missing} missed: looking again")
            wanted = min(missing + 2, n - 1)
        return nothing

    def _report(self, text: str) -> None:
        if self.progress is not None:
            self.progress(text)


def _factorise(matrix: csc_matrix) -> SuperLU:
    """Factorise a symmetric matrix without pivoting, under a symmetric ordering, which fills in least."""
    return splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})


def _padded(values: np.ndarray, vectors: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
    """Return eigenvalues ascending and eigenvectors as rows, NaN where there are fewer than k."""
    order, missing = np.argsort(values), k - values.size
    return (
        np.pad(values[order], (0, missing), constant_values=np.nan),
        np.pad(vectors[:, order].T, [(0, missing), (0, 0)], constant_values=np.nan),
    )


def _host_matrices(pencil: Pencil) -> tuple[tuple[Array, Array], Callable[..., tuple[csc_matrix, csc_matrix]]]:
    """Return the entries of K and M, and the function that makes float64 SciPy matrices of them on the host."""
    (data_k, pattern_k), (data_m, pattern_m) = pencil.stiffness.triplets(), pencil.mass.triplets()
    n = pencil.space.n_dof
    natural = bool((pencil.space.free == pencil.space.domain).all())

    def matrices(data_k: np.ndarray, data_m: np.ndarray) -> tuple[csc_matrix, csc_matrix]:
        K, M = _csc(data_k, pattern_k, n), _csc(data_m, pattern_m, n)
        if natural:  # the rows add up to zero; what float32 entries leave would act as a potential
            K = K - diags(np.asarray(K.sum(axis=1)).ravel())
        return K, M

    return (data_k, data_m), matrices


def _csc(data: np.ndarray, pattern: Pattern, n: int) -> csc_matrix:
    return coo_matrix((np.asarray(data, np.float64), pattern), shape=(n, n)).tocsc()
