"""Large sparse pencils by SciPy's shift-invert Lanczos on the host."""

from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.sparse import coo_matrix, csc_matrix
from scipy.sparse.linalg import ArpackError, ArpackNoConvergence, LinearOperator, eigsh, splu

from hks_jax.eigen.solver import Eigensolver, RawPairs
from hks_jax.fem.operators import Pattern
from hks_jax.fem.pencil import Pencil


class ShiftInvert(Eigensolver):
    """ARPACK's Lanczos (`scipy.sparse.linalg.eigsh`) on (K + sM)⁻¹M, factorised by SuperLU; float64 on the host.

    Under `jit` and `vmap` it runs through a host callback, one problem at a time; called plainly it can be
    interrupted, and reports progress.

    Attributes:
        tolerance: relative residual that counts as converged; ARPACK itself runs to machine precision.
        max_restarts: implicit restarts before giving up.
        basis: size of the Lanczos basis, more than k; None takes 2k + 20.
        progress: called with short texts such as ``"150 solves"`` while it runs; None is silent.
    """

    name: ClassVar[str] = "shift-invert"
    tolerance: float = eqx.field(default=1e-8, static=True)
    max_restarts: int = eqx.field(default=300, static=True)
    basis: int | None = eqx.field(default=None, static=True)
    progress: Callable[[str], None] | None = eqx.field(default=None, static=True)

    def max_pairs(self, n_dof: int) -> int:
        """Return n_dof − 1: a Lanczos basis must be larger than what is wanted."""
        return n_dof - 1

    def lowest(self, pencil: Pencil, k: int) -> RawPairs:
        """Return the k lowest eigenpairs."""
        stiffness, mass, volume = pencil.stiffness, pencil.mass, pencil.volume
        n, dtype, dimension = pencil.space.n_dof, stiffness.dtype, pencil.space.dimension
        data_k, pattern_k = stiffness.triplets()
        data_m, pattern_m = mass.triplets()

        def solve(data_k: np.ndarray, data_m: np.ndarray, volume: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            # The shift keeps K + sM positive definite; Weyl's λ₁ is the scale on which it is small.
            shift = 0.1 * (2 * np.pi) ** 2 / float(volume) ** (2 / dimension)
            values, vectors = self._lanczos(_csc(data_k, pattern_k, n), _csc(data_m, pattern_m, n), k, shift)
            return values.astype(dtype), vectors.astype(dtype)

        inputs = (data_k, data_m, volume)
        if not any(isinstance(x, jax.core.Tracer) for x in inputs):
            values, vectors = solve(*map(np.asarray, inputs))
            return jnp.asarray(values), jnp.asarray(vectors)
        shapes = (jax.ShapeDtypeStruct((k,), dtype), jax.ShapeDtypeStruct((k, n), dtype))
        return jax.pure_callback(solve, shapes, *inputs, vmap_method="sequential")

    def _lanczos(self, K: csc_matrix, M: csc_matrix, k: int, shift: float) -> tuple[np.ndarray, np.ndarray]:
        n = K.shape[0]
        nothing = np.full(k, np.nan), np.full((k, n), np.nan)
        if not (np.isfinite(K.data).all() and np.isfinite(M.data).all()):
            return nothing
        self._report("factorising")
        # A symmetric positive definite matrix needs no pivoting, and fills in least under a symmetric ordering.
        factor = splu(K + shift * M, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        solves = 0

        def apply_inverse(x: np.ndarray) -> np.ndarray:
            nonlocal solves
            solves += 1
            if solves % 50 == 0:
                self._report(f"{solves} solves")
            return factor.solve(x)

        inverse = LinearOperator(K.shape, matvec=apply_inverse, dtype=np.float64)
        start = np.random.default_rng(0).standard_normal(n)
        try:
            values, vectors = eigsh(
                K,
                k,
                M,
                -shift,
                OPinv=inverse,
                v0=start,
                ncv=min(n, self.basis or 2 * k + 20),
                maxiter=self.max_restarts,
            )
        except ArpackNoConvergence as stopped:
            values, vectors = stopped.eigenvalues, stopped.eigenvectors
        except ArpackError:
            return nothing
        order = np.argsort(values)
        missing = k - values.size
        return (
            np.pad(values[order], (0, missing), constant_values=np.nan),
            np.pad(vectors[:, order].T, [(0, missing), (0, 0)], constant_values=np.nan),
        )

    def _report(self, text: str) -> None:
        if self.progress is not None:
            self.progress(text)


def _csc(data: np.ndarray, pattern: Pattern, n: int) -> csc_matrix:
    return coo_matrix((np.asarray(data, np.float64), pattern), shape=(n, n)).tocsc()
