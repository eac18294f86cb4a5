"""Conversion of the users' sparse matrices into operators with one symmetric sparsity pattern."""

import math
import numbers
from functools import partial
from itertools import chain
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.sparse import BCOO, BCSR
from jaxtyping import Array, Float, Int
from scipy.sparse import identity, issparse
from scipy.sparse.linalg import LinearOperator

from hks_jax.arrays import jax_array
from hks_jax.checks import real_array, require_number
from hks_jax.fem.assembly import MassKind, assemble
from hks_jax.fem.boundary import BoundarySpec
from hks_jax.fem.elements import Quadrature
from hks_jax.fem.pencil import AnyPencil, MirrorPencil, Pencil
from hks_jax.fem.space import MatrixSpace
from hks_jax.linear.host_matrices import inertia_on_host
from hks_jax.linear.operators import ROUNDING, DiagonalOperator, Operator, SparseOperator, require_symmetric
from hks_jax.linear.pattern import SparsePattern
from hks_jax.linear.symmetric_pencil import NullSpace, SymmetricPencil
from hks_jax.traced import is_traced

_FEW = 8
"""The number of null vectors up to which `require_null_space` checks each vector."""


class _Entries(NamedTuple):
    """The entries of a matrix; entries with the same row and column add up."""

    values: Float[Array, " m"]
    rows: Int[np.ndarray, " m"]
    cols: Int[np.ndarray, " m"]
    size: int


def sparse_pencil(
    K: Any,
    M: Any = None,
    *,
    null_vectors: Any = None,
    dimension: int | None = None,
    volume: Any = None,
    shape: tuple[int, ...] | None = None,
) -> Pencil:
    """Return the pencil of two matrices, whose pattern becomes the union of both patterns and their transposes.

    Both matrices, and their tangents in derivatives, are replaced by their symmetric parts. All signatures can be
    computed from the eigenpairs. A signature that needs a missing ``dimension`` or ``volume`` raises ValueError.

    Args:
        K: a symmetric matrix (n, n): a SciPy sparse matrix, a BCOO or BCSR of `jax.experimental.sparse` (whose data
            may be traced, but not its indices), an operator of this package, or a full array; or a pencil, which
            includes M.
        M: a symmetric positive definite matrix of the same kinds, or its diagonal (n,); None is the identity. The
            sparsity patterns of M and K may differ.
        null_vectors: (m, n) a basis of the whole null space of K ⪰ 0, where m may be 0. If no basis is given, K may be
            indefinite, and eigenvalues that are zero within rounding are set to zero. In float32, a component of K
            whose rows sum to zero within rounding counts as a graph Laplacian (docs/accuracy.md).
        dimension: the dimension of the manifold, 2 or 3; Weyl's law and ``normalisation="flat"`` need this number.
        volume: the volume of the manifold in the units of the metric, for Weyl's law and ``normalisation="volume"``.
        shape: the shape of nodal arrays, with n nodes; None is (n,).

    Raises:
        ValueError: matrices that are not square, differ in size, are complex, NaN, infinite or unsymmetric (the message
            has the entry); a diagonal M with an entry that is not positive; traced indices; null vectors that are
            linearly dependent, or that K does not annihilate (with the residual); a bad dimension, volume or shape.

    Examples:
        >>> K = np.array([[1.0, -1.0, 0.0], [-1.0, 2.0, -1.0], [0.0, -1.0, 1.0]])  # a path of three nodes
        >>> print(hj.eigenpairs(hj.sparse_pencil(K, null_vectors=np.ones((1, 3))), k=3).eigenvalues.round())
        [0. 1. 3.]
    """
    if isinstance(K, SymmetricPencil):
        if M is not None:
            raise ValueError("M: got a mass for a pencil, which has one already; leave M out")
        K, M = K.stiffness, K.mass
    pencil = _pencil(K, M)
    n, dtype = pencil.size, pencil.stiffness.dtype
    if dimension not in (None, 2, 3):
        raise ValueError(f"dimension: got {dimension!r}; expected 2 or 3, or None if there is no manifold")
    if shape is not None:
        shape = (int(shape),) if isinstance(shape, numbers.Integral) else tuple(shape)
        if math.prod(shape) != n or min(shape) < 1:
            raise ValueError(f"shape: got {shape}, {math.prod(shape)} nodes; expected {n} nodes")
    if volume is not None:
        require_number("volume", volume)
        volume = jnp.asarray(volume, dtype)
    space = MatrixSpace(tuple(shape or (n,)), dimension)
    null_space = None if null_vectors is None else NullSpace(_checked_null_vectors(pencil, null_vectors))
    return Pencil(pencil.stiffness, pencil.mass, None, volume, space, null_space=null_space)


def pencil_of(domain: Any, boundary: BoundarySpec, mass: MassKind, quadrature: Quadrature = "gauss") -> AnyPencil:
    """Return the pencil of a field, a mesh, a matrix K or a pair (K, M); a given pencil is checked and returned."""
    kinds = BCOO | BCSR | Operator | np.ndarray | jax.Array | list | LinearOperator
    matrix = issparse(domain) or isinstance(domain, kinds)
    if not matrix and not isinstance(domain, SymmetricPencil | MirrorPencil | tuple):
        return assemble(domain, boundary, mass, quadrature=quadrature)
    if (boundary, mass, quadrature) != ("neumann", "consistent", "gauss"):
        raise ValueError("boundary, mass, quadrature: a pencil has them already; pass them to `assemble` instead")
    if isinstance(domain, tuple) and len(domain) != 2:
        raise ValueError(f"domain: got a tuple of {len(domain)} entries; expected a pair (K, M)")
    if not isinstance(domain, Pencil | MirrorPencil):
        domain = sparse_pencil(*domain) if isinstance(domain, tuple) else sparse_pencil(domain)
    if isinstance(domain, Pencil) and isinstance(domain.space, MatrixSpace):
        matrices = domain.stiffness, domain.mass
        _require_equal_dtypes(domain.mass.dtype, domain.stiffness.dtype)
        symmetric = [m.symmetric_part() if isinstance(m, SparseOperator) else m for m in matrices]
        domain = eqx.tree_at(lambda p: (p.stiffness, p.mass), domain, symmetric)
    for part in jax.lax.stop_gradient(domain).parts:
        require_null_space(part)
        _require_definite_mass(part)
    return domain


def _require_equal_dtypes(of_mass: np.dtype, of_stiffness: np.dtype) -> None:
    if of_mass != of_stiffness:
        raise ValueError(f"M: got {of_mass}; expected {of_stiffness}, the dtype of K. Convert one of them with .astype")


def _require_definite_mass(pencil: Pencil) -> None:
    """Raise ValueError if the user's own M, in a matrix or a form, is concrete and not positive definite."""
    custom = isinstance(pencil.space, MatrixSpace) or pencil.volume is None
    if not custom or isinstance(pencil.mass, DiagonalOperator) or is_traced(pencil):
        return
    negative, sound = inertia_on_host(pencil.mass.to_scipy().tocsc(), identity(pencil.size, format="csc"), 0.0)
    if negative or not sound:
        what = f"{negative} negative eigenvalue(s)" if sound else "an eigenvalue that is zero within rounding"
        name = "M" if isinstance(pencil.space, MatrixSpace) else "mass"
        raise ValueError(f"{name}: got a matrix with {what} by its inertia; expected a positive definite matrix")


def _checked_null_vectors(pencil: SymmetricPencil, null_vectors: Any) -> Float[Array, "m n"]:
    vectors = jnp.asarray(real_array("null_vectors", null_vectors), pencil.stiffness.dtype)
    if vectors.ndim != 2 or vectors.shape[1] != pencil.size or len(vectors) > pencil.size:
        raise ValueError(f"null_vectors: got shape {vectors.shape}; expected (m, {pencil.size}), one vector per row")
    if not is_traced(vectors) and len(vectors):
        lengths = np.linalg.norm(np.asarray(vectors), axis=1, keepdims=True)
        sizes = np.linalg.svd(np.asarray(vectors) / np.where(lengths > 0, lengths, 1), compute_uv=False)
        if sizes[-1] < np.finfo(vectors.dtype).eps ** 0.25:
            raise ValueError(
                "null_vectors: got linearly dependent vectors (the least singular value of their matrix, after "
                f"normalisation, is {sizes[-1]:.2g}); "
                "expected a basis. Orthogonalise the vectors, and leave out zero vectors"
            )
    require_null_space(SymmetricPencil(pencil.stiffness, pencil.mass, null_space=NullSpace(vectors)))
    # The vectors are made orthonormal, so that they can be made M-orthonormal up to rounding.
    return vectors if is_traced(vectors) else jax_array(np.linalg.qr(np.asarray(vectors).T)[0].T)


def require_null_space(pencil: SymmetricPencil) -> None:
    """Raise ValueError unless the stiffness annihilates the pencil's null space; traced values are not checked."""
    if pencil.null_space is None or is_traced(pencil) or not pencil.n_null:
        return
    where, rows, cols = pencil.pattern.places()
    data, finfo = np.asarray(pencil.stiffness.flat())[where], np.finfo(pencil.stiffness.dtype)
    size = max(np.bincount(rows, np.abs(data), pencil.size).max(), finfo.tiny)

    def defect(vector: np.ndarray) -> float:
        image = np.bincount(rows, data * vector[cols], pencil.size)
        return float(np.abs(image).max() / max(np.abs(vector).max(), finfo.tiny) / size)

    vectors = np.asarray(pencil.null_space.vectors)
    lengths = np.abs(vectors).max(axis=1, keepdims=True)
    # Of more than `_FEW` null vectors, only a random linear combination is checked.
    weights = np.random.default_rng(0).standard_normal(len(vectors))
    some = vectors if len(vectors) <= _FEW else [weights @ (vectors / np.where(lengths > 0, lengths, 1))]
    if max(map(defect, some)) > ROUNDING * finfo.eps:
        defects = [defect(vector) for vector in vectors]
        worst = int(np.argmax(defects))
        raise ValueError(
            f"null_vectors: the stiffness does not annihilate vector {worst}: ‖Kv‖ is {defects[worst]:.2g} ‖K‖ ‖v‖ in "
            "the maximum norm, which is more than rounding. If K has changed, pass no null vectors: use "
            "`pencil.with_stiffness(K)` or `sparse_pencil(K, M)`"
        )


def _pencil(K: Any, M: Any) -> SymmetricPencil:
    for name, matrix in (("K", K), ("M", M)):
        if isinstance(matrix, LinearOperator):
            raise TypeError(
                f"{name}: got a LinearOperator; expected a matrix with entries to factorise, sparse or dense"
            )
    if np.ndim(M) == 0 and isinstance(M, numbers.Number):
        raise ValueError(f"M: got the number {M}; expected a matrix, its diagonal or None. If this is k, pass k={M}")
    stiffness = _entries("K", K)
    n, dtype = stiffness.size, stiffness.values.dtype
    diagonal, matrices = _diagonal(M, n, dtype), [stiffness]
    if diagonal is None:
        mass = _entries("M", M)
        if mass.size != n:
            raise ValueError(f"M: got shape {(mass.size, mass.size)}; expected {(n, n)}, the shape of K")
        if (mass.rows == mass.cols).all():
            diagonal = jnp.zeros(n, mass.values.dtype).at[jnp.asarray(mass.rows)].add(mass.values)
        else:
            matrices.append(mass)
    given = matrices[-1].values.dtype if diagonal is None else diagonal.dtype
    _require_equal_dtypes(given, dtype)
    if diagonal is not None and not is_traced(diagonal):
        wrong = np.flatnonzero(~(np.asarray(diagonal) > 0))
        if wrong.size:
            raise ValueError(
                f"M: {wrong.size} of its {diagonal.size} diagonal entries are not positive (the first is "
                f"{float(diagonal[wrong[0]]):.6g}, in row {wrong[0]}); expected a positive definite mass"
            )
    # The pattern is the union of the patterns of all matrices, their transposes and the diagonal.
    keys = [[a.astype(np.int64) * n + b for a, b in ((m.rows, m.cols), (m.cols, m.rows))] for m in matrices]
    places = np.unique(np.concatenate([*chain(*keys), np.arange(n) * (n + 1)]))
    pattern = SparsePattern(n, places // n, places % n)
    one, *other = (
        SparseOperator(_symmetric_part(m.values, *np.searchsorted(places, both), places.size), pattern)
        for m, both in zip(matrices, keys, strict=True)
    )
    return SymmetricPencil(one, other[0] if diagonal is None else DiagonalOperator(diagonal))


def _entries(name: str, matrix: Any) -> _Entries:
    """Return the entries of a square matrix; check the symmetry of the matrix unless the entries are traced."""
    if not isinstance(matrix, BCOO | BCSR | Operator) and not issparse(matrix):
        matrix = real_array(name, matrix)
    if isinstance(matrix, BCOO | BCSR) and (matrix.n_batch or matrix.n_dense):
        raise ValueError(f"{name}: got a BCOO with batch or dense axes; expected none (use jax.vmap over its data)")
    if len(matrix.shape) != 2 or matrix.shape[0] != matrix.shape[1] or matrix.shape[0] == 0:
        remedy = ". For tensors, pass TensorField(grid, tensors)" * (len(matrix.shape) > 2)
        raise ValueError(f"{name}: got shape {tuple(matrix.shape)}; expected a square matrix (n, n){remedy}")
    n = matrix.shape[0]
    if isinstance(matrix, BCSR):
        matrix = matrix.to_bcoo()
    if isinstance(matrix, BCOO):
        if is_traced(matrix.indices):
            raise ValueError(
                f"{name}: its indices are traced; expected a known pattern. Make the array of indices outside jax.jit "
                "and the matrix from it inside, or make the pencil outside with `sparse_pencil` and pass it"
            )
        rows, cols = np.asarray(matrix.indices).T
        valid = np.flatnonzero((rows < n) & (cols < n))  # other indices are padding
        values, rows, cols = matrix.data[valid], rows[valid], cols[valid]
    elif isinstance(matrix, Operator):
        values, (rows, cols) = matrix.triplets()
    elif issparse(matrix):
        held = matrix.tocsr().tocoo()  # entries in the same place are added
        values, rows, cols = held.data, held.row, held.col
    else:
        rows, cols = np.divmod(np.arange(n * n), n) if is_traced(matrix) else np.nonzero(np.asarray(matrix))
        values = matrix[rows, cols]
    values = real_array(name, values)
    if not is_traced(values):
        require_symmetric(name, values, (rows, cols), n, f"If this is noise, pass ({name} + {name}.T) / 2")
    return _Entries(values, rows, cols, n)


def _diagonal(M: Any, n: int, dtype: np.dtype) -> Array | None:
    """Return the diagonal of a mass that is given by its diagonal or by None, the identity; otherwise return None."""
    if M is None:
        return jnp.ones(n, dtype)
    if isinstance(M, DiagonalOperator):
        M = M.entries
    if issparse(M) or isinstance(M, BCOO | BCSR | Operator) or np.ndim(M) != 1:
        return None
    entries = real_array("M", M)
    if entries.shape != (n,):
        raise ValueError(f"M: got a diagonal of shape {entries.shape}; expected {(n,)}")
    return entries


@partial(jax.jit, static_argnums=3)
def _symmetric_part(values: Array, places: Array, transposed: Array, size: int) -> Float[Array, " size"]:
    """Return ``size`` entries: half of each value at its place, and half at the transposed place."""
    return jnp.zeros(size, values.dtype).at[places].add(values / 2).at[transposed].add(values / 2)
