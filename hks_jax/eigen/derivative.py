"""Derivatives of eigenpairs with respect to stiffness and mass."""

from dataclasses import replace
from functools import partial
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from hks_jax.accuracy import warn_of_accuracy
from hks_jax.compilation import library_of, numpy_where_known
from hks_jax.eigen.adjoints.complement import Adjoint, OfRows, Rows, Scalar, Values, Vectors, unsolved
from hks_jax.eigen.quality import indistinct
from hks_jax.eigen.rotations import gaps
from hks_jax.eigen.solver import Eigensolver, RawPairs, Report
from hks_jax.fem.pencil import Pencil
from hks_jax.linear import lapack
from hks_jax.linear.linear_map import first_order_only, with_transpose
from hks_jax.linear.linear_program import HostMap, linear_program
from hks_jax.linear.loops import one_by_one
from hks_jax.linear.products import inner_products, matmul
from hks_jax.linear.symmetric_pencil import SymmetricPencil
from hks_jax.traced import is_traced

OnFailure = Literal["nothing", "warning", "error"]
"""The action if the linear solves of a derivative do not converge; the derivative is NaN in any case."""

_ON_HOST = 1 << 22
"""The largest total size of eigenvectors at which NumPy computes derivatives as fast as compiled JAX code does."""


@partial(jax.custom_jvp, nondiff_argnums=(0, 2, 3, 4, 5))
def solved(
    solver: Eigensolver, pencil: Pencil, k: int, extra: int, throw: bool, report: Report, start: Array | None = None
) -> tuple[Values, Vectors, Scalar, Scalar, Array | None]:
    """Return the k lowest eigenvalues, the frame of their eigenvectors, the next eigenvalue, a certified bound, and the
    vectors beyond the k-th if the solver keeps them.

    The frame is equal to the eigenvectors, but its derivative excludes rotations of the k eigenvectors among
    themselves, which `hks_jax.eigen.rotations` adds. The next eigenvalue is infinite unless ``extra`` = 1. The solver
    certifies that none of the k eigenvalues is missing below the bound. Derivatives treat the next eigenvalue and the
    bound as constants. Derivatives whose linear solves do not converge are NaN, and raise an error if ``throw`` is set,
    or else cause a warning if values are concrete.
    """
    values, vectors, complete_below = one_by_one(_lowest, (solver, k + extra, report), pencil, start)
    *found, spare = _cut(values, vectors, k)
    return *found, complete_below, spare


# Let fᵢ = (dK − λᵢ dM) φᵢ, called the force. From Kφᵢ = λᵢMφᵢ and φᵢᵀMφⱼ = δᵢⱼ it follows that
#
#     dλᵢ = φᵢᵀfᵢ,    dφᵢ = −½ (φᵢᵀ dM φᵢ) φᵢ + Σ_{j≠i} φⱼ (φⱼᵀfᵢ)/(λᵢ − λⱼ).
#
# The derivative of the frame has only the terms of dφᵢ with j > k. Its terms for the guard pairs, which the solver
# computes beyond k, are evaluated directly. The sum xᵢ of all other terms solves
#
#     (K − λᵢM) xᵢ = −Q fᵢ,   Φᵀ M xᵢ = 0,   Q = I − MΦΦᵀ,
#
# on the M-orthogonal complement of all computed eigenvectors Φ, where K − λᵢM is positive definite. Reverse mode uses
# the symmetry of the map fᵢ ↦ xᵢ. Because of the guard pairs, λᵢ is not close to the eigenvalues on the complement of
# Φ.
@solved.defjvp
def _solved_jvp(
    solver: Eigensolver, k: int, extra: int, throw: bool, report: Report, primals: Any, changes: Any
) -> tuple[tuple, tuple]:
    pencil, start, change = first_order_only(primals[0]), primals[1], changes[0]
    n_dof, adjoint = pencil.size, solver.adjoint
    guards = max(extra, min(solver.guards(k, n_dof), solver.max_pairs(n_dof) - k))
    found, vectors, complete_below = one_by_one(_lowest, (solver, k + guards, report), pencil, start)
    eigenvalues, frame, following, spare = _cut(found, vectors, k)
    vectors = vectors if spare is None else vectors[: len(found)]
    origin, from_origin, solves = jnp.zeros((), found.dtype), found, _solves(pencil, k, len(found))
    if solves and pencil.null_space is None:  # linear solves need K ⪰ 0
        origin = _below(found, indistinct(pencil, found.dtype))
        pencil, from_origin = pencil.counted_from(origin), found - origin
    # Data from `prepare` do not depend on the pencil's tangent, so all products with one Jacobian share these data.
    prepared = one_by_one(_prepare, (adjoint, k), pencil, from_origin) if solves else None
    # Metric and density are removed: derivatives do not need them, and reverse mode would store their arrays.
    pencil = replace(pencil, metric=None, density=None)
    on_failure: OnFailure = "error" if throw else "nothing" if is_traced(primals) else "warning"
    constants, settings = _Constants(prepared, pencil, origin, from_origin, vectors, frame), (adjoint, on_failure)
    tangents = linear_program(_tangents, settings, (constants,), change, (eigenvalues, frame), _host_map)
    others = following if extra else jnp.full_like(following, jnp.inf), complete_below, spare
    return (eigenvalues, frame, *others), (*tangents, *jax.tree.map(jnp.zeros_like, others))


class _Constants(NamedTuple):
    """The constants of the derivative: the matrices K − σM and M, their first p eigenpairs, and k of the vectors."""

    prepared: Any  # the result of `Adjoint.prepare`
    pencil: SymmetricPencil
    origin: Scalar  # σ
    values: Values  # (p,) the eigenvalues of K − σM and M
    vectors: Vectors
    frame: Rows  # the first k vectors, because slicing ``vectors`` would copy the slice


# `one_by_one` needs the same function object in every call; so `_lowest` and `_prepare` are at module level.
def _lowest(solver: Eigensolver, k: int, report: Report, pencil: SymmetricPencil, start: Array | None) -> RawPairs:
    """Return the solver's pairs with the exact null vectors of the pencil."""
    lowest: Any = solver.lowest
    values, vectors, bound = lowest(pencil, k, report, start) if solver.starts else lowest(pencil, k, report)
    if pencil.null_space is not None and pencil.n_null:
        values, vectors = _with_null_modes(pencil.mass, pencil.null_space.vectors, values, vectors)
    return values, vectors, bound


@numpy_where_known(static_argnums=2)
def _cut(values: Any, vectors: Any, k: int) -> tuple[Any, Any, Any, Any]:
    """Return k pairs, the next eigenvalue and, if the solver returned more vectors than pairs, those after the k-th."""
    xp = library_of(values)
    following = values[k] if len(values) > k else xp.asarray(xp.inf, values.dtype)
    return values[:k], vectors[:k], following, vectors[k:] if len(vectors) > len(values) else None


@numpy_where_known()
def _below(values: Any, rounding: Any) -> Any:
    """Return the lowest eigenvalue minus the mean gap or, if all eigenvalues are equal, minus some rounding errors."""
    xp = library_of(values)
    gap = (values[-1] - values[0]) / values.size
    return values[0] - xp.where(gap > rounding, gap, 1e3 * rounding)


def _solves(pencil: SymmetricPencil, k: int, p: int) -> bool:
    """Return whether derivatives of the first k of p computed pairs have components along other eigenvectors."""
    return p < pencil.size and pencil.n_fixed < k


def _host_map(adjoint: Adjoint, on_failure: OnFailure, constants: _Constants) -> HostMap | None:
    """Return `_tangents` by NumPy."""
    prepared, pencil, origin, values, vectors, frame = constants
    if vectors.size > _ON_HOST:
        return None
    k, rows = len(frame), np.asarray(frame)
    guards = np.asarray(vectors)[k:]
    eigenvalues = (np.asarray(values)[:k] + np.asarray(origin))[:, None]
    _, inverse = gaps(np.asarray(values), k, np.asarray(indistinct(pencil, values.dtype)))

    def outside(rhs: np.ndarray) -> np.ndarray:
        if not _solves(pencil, k, len(values)):
            return np.zeros_like(rhs)
        free = np.arange(k)[:, None] >= pencil.n_fixed
        free_rhs = jax.device_put(np.where(free, rhs, 0))
        solution = np.asarray(adjoint.solve(prepared, pencil, values, vectors, free_rhs))
        if np.isnan(solution).any():
            _checked(on_failure, jax.device_put(solution))
        return np.where(free, solution, 0)

    def onto(force: np.ndarray) -> np.ndarray:
        return (inverse[:, k:] * (force @ guards.T)) @ guards - outside(force)

    def apply(change: SymmetricPencil) -> tuple[np.ndarray, np.ndarray]:
        moved = (change.mass.to_scipy() @ rows.T).T
        force = (change.stiffness.to_scipy() @ rows.T).T - eigenvalues * moved
        return np.sum(rows * force, axis=1), onto(force)

    def transpose(like: SymmetricPencil, y: tuple[np.ndarray, np.ndarray]) -> SymmetricPencil:
        of_values, of_frame = y
        force = of_values[:, None] * rows + onto(of_frame)
        return change_of(like, rows, force, -eigenvalues * force)

    return HostMap(apply, transpose)


def change_of(change: SymmetricPencil, x: Rows, *p: Rows) -> SymmetricPencil:
    """Return a pencil's cotangent with stiffness Σᵢ aᵢxᵢᵀ and mass Σᵢ bᵢxᵢᵀ, for the rows xᵢ of x and p = (a, b)."""
    zeros = jax.tree.map(lambda like: jax.device_put(np.zeros(like.shape, like.dtype)), change)
    matrices = tuple(matrix.outer(each, x) for matrix, each in zip((zeros.stiffness, zeros.mass), p, strict=True))
    return eqx.tree_at(lambda pencil: (pencil.stiffness, pencil.mass), zeros, matrices)


# Without the checkpoint, reverse mode would store copies of the eigenvectors.
@partial(jax.checkpoint, static_argnums=(0, 1))
def _tangents(
    adjoint: Adjoint, on_failure: OnFailure, constants: _Constants, change: SymmetricPencil
) -> tuple[OfRows, Rows]:
    """Return the tangents of the first k eigenvalues, and of the frame of `solved`, for the change of K and M."""
    prepared, pencil, origin, values, vectors, frame = constants
    k = len(frame)
    eigenvalues, guards = values[:k] + origin, vectors[k:]
    moved = change.mass.apply(frame)
    force = change.stiffness.apply(frame) - eigenvalues[:, None] * moved
    _, inverse = gaps(values, k, indistinct(pencil, values.dtype))

    # `onto_guards` is symmetric, so it is its own transpose. JAX's automatic transpose would be several times slower.
    def onto_guards(force: Rows) -> Rows:
        return matmul(inverse[:, k:] * inner_products(guards, force), guards)

    def solve(_: object, rhs: Rows) -> Rows:
        return _checked(on_failure, one_by_one(type(adjoint).solve, (adjoint,), prepared, pencil, values, vectors, rhs))

    of_frame = with_transpose(onto_guards, onto_guards, force)
    if _solves(pencil, k, len(values)):
        # If every perturbation of K annihilates a null vector φᵢ, its force fᵢ is zero, and so is xᵢ. In reverse mode,
        # a cotangent that may be nonzero replaces fᵢ, so xᵢ is set to zero for such null vectors. JAX would
        # use products with K − λᵢM only in second derivatives, which are not supported; the identity replaces them.
        free = np.arange(k)[:, None] >= pencil.n_fixed
        rhs = jnp.where(free, -force, 0)
        of_frame = of_frame + jnp.where(free, jax.lax.custom_linear_solve(lambda x: x, rhs, solve, symmetric=True), 0)
    return jnp.sum(frame * force, axis=1), of_frame


def _prepare(adjoint: Adjoint, k: int, pencil: SymmetricPencil, values: Values) -> Any:
    return adjoint.prepare(pencil, values, k)


def _checked(on_failure: OnFailure, x: Rows) -> Rows:
    """Return the solutions x; if rows of x are NaN, also warn or raise an error as ``on_failure`` states."""
    failed = jnp.sum(jnp.any(jnp.isnan(x), axis=1))
    if on_failure == "error":
        return eqx.error_if(x, failed > 0, unsolved("some", len(x)))
    if on_failure == "warning":

        def warn(failed: Array | np.ndarray) -> np.ndarray:
            if failed:
                warn_of_accuracy(unsolved(int(failed), len(x)))
            return np.zeros((), x.dtype)

        return x + jax.pure_callback(warn, jax.ShapeDtypeStruct((), x.dtype), failed, vmap_method="sequential")
    return x


@numpy_where_known()
def _with_null_modes(mass: Any, nulls: Any, values: Any, vectors: Any) -> tuple[Any, Any]:
    """Replace the solver's approximations of null vectors by the pencil's null vectors.

    The eigenvalues of null vectors become 0, not about ±1e-13. All other vectors become M-orthogonal to null vectors.
    """
    xp = library_of(values)
    product: Any
    inverse_cholesky: Any
    if xp is jnp:
        product, inverse_cholesky = matmul, lapack.inverse_cholesky
        nulls = jax.lax.optimization_barrier(nulls)  # keeps XLA from folding these constants
    else:
        product, inverse_cholesky = np.matmul, lambda gram: np.linalg.inv(np.linalg.cholesky(gram))
    nulls = nulls[: values.size]
    image = (mass @ nulls.T).T
    lengths = xp.sqrt(xp.sum(nulls * image, axis=1, keepdims=True))
    nulls, image = nulls / lengths, image / lengths
    orthonormal = inverse_cholesky(product(nulls, image.T))
    nulls, image = product(orthonormal, nulls), product(orthonormal, image)
    share = product(vectors, image.T)
    vectors = vectors - product(share, nulls)
    vectors = vectors / xp.sqrt(1 - xp.sum(share * share, axis=1, keepdims=True))
    n_null = len(nulls)
    return xp.concatenate([xp.zeros_like(values[:n_null]), values[n_null:]]), xp.concatenate([nulls, vectors[n_null:]])
