"""Large sparse pencils by SciPy's shift-invert Lanczos on the host."""

from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import ArpackError, ArpackNoConvergence, LinearOperator, eigsh

from hks_jax.eigen.host import complement_on_host, factorise_on_host, host_matrices
from hks_jax.eigen.solver import Eigensolver, RawPairs
from hks_jax.fem.pencil import Pencil
from hks_jax.traced import is_traced

Found = tuple[np.ndarray, np.ndarray, float]

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
        """Return the k lowest eigenpairs, and the shift at which inertia confirmed them."""
        n, dtype, dimension = pencil.space.n_dof, pencil.stiffness.dtype, pencil.space.dimension
        (data_k, data_m), matrices = host_matrices(pencil)

        def solve(data_k: np.ndarray, data_m: np.ndarray, volume: np.ndarray) -> tuple[np.ndarray, ...]:
            # The shift keeps K + sM positive definite; Weyl's λ₁ is the scale on which it is small.
            shift = 0.1 * (2 * np.pi) ** 2 / float(volume) ** (2 / dimension)
            K, M = matrices(data_k, data_m)
            return tuple(np.asarray(found, dtype) for found in self._lanczos(K, M, k, shift))

        inputs = (data_k, data_m, pencil.volume)
        if not is_traced(inputs):
            values, vectors, complete_below = map(jnp.asarray, solve(*map(np.asarray, inputs)))
            return values, vectors, complete_below
        shapes = tuple(jax.ShapeDtypeStruct(shape, dtype) for shape in ((k,), (k, n), ()))
        return jax.pure_callback(solve, shapes, *inputs, vmap_method="sequential")

    def solve_complement(
        self,
        prepared: None,
        pencil: Pencil,
        values: Float[Array, " p"],
        vectors: Float[Array, "p n_dof"],
        rhs: Float[Array, "k n_dof"],
    ) -> Float[Array, "k n_dof"]:
        """Solve (K − λᵢM) xᵢ = (I − MΦΦᵀ) rhsᵢ with ΦᵀMxᵢ = 0; see `hks_jax.eigen.complement`."""
        return complement_on_host(pencil, values, vectors, rhs, self.derivative_tolerance, self._report)

    def _lanczos(self, K: csc_matrix, M: csc_matrix, k: int, shift: float) -> Found:
        n = K.shape[0]
        nothing = np.full(k, np.nan), np.full((k, n), np.nan), np.nan
        if not (np.isfinite(K.data).all() and np.isfinite(M.data).all()):
            return nothing
        self._report("factorising")
        factor = factorise_on_host(K + shift * M)
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
                return _padded(stopped.eigenvalues, stopped.eigenvectors, k, np.nan) if seed == 0 else nothing
            except ArpackError:
                return nothing
            order = np.argsort(np.concatenate([values, more]))[:k]
            values = np.concatenate([values, more])[order]
            vectors = np.concatenate([vectors, found], axis=1)[:, order]
            # Lanczos with single vectors can miss copies of a multiple eigenvalue. By Sylvester's law of inertia the
            # negative pivots of K − σM count the eigenvalues below σ: look again, past what is found, for the missing.
            below = values[-1] - 1e-6 * max(values[-1], shift)
            if below <= 0:  # nothing but constants
                return _padded(values, vectors, k, max(below, 0.0))
            missing = int((factorise_on_host(K - below * M).U.diagonal() < 0).sum()) - int((values < below).sum())
            if missing <= 0:
                return _padded(values, vectors, k, max(below, 0.0))
            self._report(f"{missing} missed: looking again")
            wanted = min(missing + 2, n - 1)
        return nothing

    def _report(self, text: str) -> None:
        if self.progress is not None:
            self.progress(text)


def _padded(values: np.ndarray, vectors: np.ndarray, k: int, complete_below: float) -> Found:
    """Return eigenvalues ascending and eigenvectors as rows, NaN where there are fewer than k."""
    order, missing = np.argsort(values), k - values.size
    return (
        np.pad(values[order], (0, missing), constant_values=np.nan),
        np.pad(vectors[:, order].T, [(0, missing), (0, 0)], constant_values=np.nan),
        complete_below,
    )
