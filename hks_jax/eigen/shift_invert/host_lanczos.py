"""Block Lanczos on (K − σM)⁻¹M for the eigenvalues nearest to a shift σ, in NumPy.

The method is that of `hks_jax.eigen.lanczos.recurrence`, but with blocks of varying width: directions that the basis
contains already are dropped, and random blocks continue a Krylov space that is exhausted.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float
from scipy.sparse import csr_matrix

Columns = Float[np.ndarray, "n b"]
Block = tuple[Float[np.ndarray, "n c"], Float[np.ndarray, "n c"], Float[np.ndarray, "c _b"]]
"""The M-orthonormal columns of a block y, their images My, and the matrix R that couples it to the block before it."""

_CONVERGED = 1e-12
"""The relative residual ‖Aφ − θφ‖/|θ| at which a Ritz pair of A = (K − σM)⁻¹M counts as converged."""
_ROUNDING = 8 * float(np.finfo(float).eps)
"""The residual ‖Aφ − θφ‖ relative to the largest |θ| that is due to rounding."""
_NOTHING = 1e-13
"""The norm at which a direction counts as contained in the basis, relative to the largest entry of VᵀMAV."""
_SMALL = 1e-6
"""The norm, likewise relative, of directions that are orthogonalised again after normalisation."""
_CROWDED = 3
"""From a third of all dimensions on, every step orthogonalises, because new directions are small."""


def nearest(
    solve: Callable[[Columns], Columns],  # x ↦ (K − σM)⁻¹x
    mass: csr_matrix,
    shift: float,
    known: Float[np.ndarray, "n p"],  # M-orthonormal eigenvectors, to which the search is orthogonal
    count: int,
    radius: float,
    block: int,
    expected: int,
    room: int,
    seed: int,
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "n m"]]:
    """Return all eigenvalues within ``radius`` of the shift, and at least ``count``, with M-orthonormal eigenvectors.

    The eigenvalues are in no order; eigenvectors are columns. Copies of multiple eigenvalues may be missing. If the
    basis has ``room`` vectors, the result has those that converged and are nearer than all others. It is empty if
    solutions are not finite. The first test for convergence is at ``expected`` basis vectors.
    """
    n, p = known.shape
    room, rng = min(room, n - p), np.random.default_rng(seed)
    # The known vectors are the first p rows. The basis V follows, and has m vectors so far.
    basis, matrix = np.empty((p + room, n)), np.zeros((room, room))  # matrix: VᵀMAV
    basis[:p] = known.T
    m, turn, largest = 0, 0, 0.0

    def project(x: Columns) -> Columns:
        return x - basis[: p + m].T @ (basis[: p + m] @ (mass @ x))

    def random_block() -> Block:
        x = rng.standard_normal((n, min(block, room - m)))
        for _ in range(2):
            x, image, _ = _orthonormal(mass, project(x), 0.0)
        return x, image, np.zeros((x.shape[1], 0))

    current, image, coupling = random_block()
    before = np.zeros((n, 0))
    while True:
        rows, width = p + m, current.shape[1]
        onward = solve(image) - before @ coupling.T
        diagonal = image.T @ onward
        diagonal = (diagonal + diagonal.T) / 2
        onward -= current @ diagonal
        if not np.isfinite(diagonal).all() or not diagonal.any():
            return np.empty(0), np.empty((n, 0))
        crowded = _CROWDED * (rows + width) > n
        if turn % 2 or crowded:  # every second step orthogonalises against the whole basis, two blocks at once
            parts = basis[:rows].T @ (basis[:rows] @ np.concatenate([image, mass @ onward], axis=1))
            current = current - parts[:, :width]
            onward -= parts[:, width:]
            onward -= current @ (image.T @ onward)
        basis[rows : rows + width] = current.T
        matrix[m : m + width, m : m + width] = diagonal
        m, turn, before = m + width, turn + 1, current
        largest = max(largest, np.abs(diagonal).max())
        current, image, coupling = _orthonormal(mass, onward, _NOTHING * largest)
        if crowded or np.linalg.norm(coupling, axis=1).min(initial=np.inf) < _SMALL * largest:
            # The normalisation of a small direction has enlarged its components along the basis; a direction that
            # consists of these is dropped.
            current, image, change = _orthonormal(mass, project(current), 0.5)
            coupling = change @ coupling
        if m >= expected or m == room:
            theta, modes = np.linalg.eigh(matrix[:m, :m])
            residuals, sizes = np.linalg.norm(coupling @ modes[m - width :], axis=0), np.abs(theta)
            converged = residuals <= np.maximum(_CONVERGED * sizes, _ROUNDING * sizes.max())
            converged |= m == n - p  # the basis has all dimensions
            # An unconverged value may hide another one, so only values nearer than all unconverged ones count.
            limit = sizes[~converged].max(initial=0)
            near = sizes > limit
            if m == room or (near.sum() >= count and radius * limit <= 1):
                return shift + 1 / theta[near], basis[p : p + m].T @ modes[:, near]
            expected = m + max(2 * block, m // 12)
        if not current.shape[1]:
            current, image, _ = random_block()
            coupling = np.zeros((current.shape[1], width))
        left = slice(max(len(coupling) - (room - m), 0), None)  # the last directions are the largest
        current, image, coupling = current[:, left], image[:, left], coupling[left]
        after = slice(m, m + len(coupling))
        matrix[after, m - width : m] = coupling
        matrix[m - width : m, after] = coupling.T


def _orthonormal(mass: csr_matrix, x: Columns, least: float) -> Block:
    """Return M-orthonormal columns y, My, and R with x = yR, without directions of norms up to ``least``."""
    image, factor = mass @ x, np.eye(x.shape[1])
    for limit in (least, 0.0):  # twice, for orthogonality within rounding
        squares, turned = np.linalg.eigh(x.T @ image)
        kept = squares > limit**2
        norms, turned = np.sqrt(squares[kept]), turned[:, kept]
        x, image, factor = x @ (turned / norms), image @ (turned / norms), (norms[:, None] * turned.T) @ factor
    return x, image, factor
