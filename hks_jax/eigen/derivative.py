"""Derivatives of eigenpairs, the lowest or the first above an origin, with respect to stiffness and mass."""

from collections.abc import Callable
from functools import partial
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from hks_jax.accuracy import warn_of_accuracy
from hks_jax.compilation import by_numpy, jit_quickly, known_and_few, numpy_where_known
from hks_jax.eigen.complement.adjoint import Adjoint, unsolved
from hks_jax.eigen.complement.factorised_adjoint import InteriorAdjoint
from hks_jax.eigen.lanczos.block_lanczos import first_from_origin
from hks_jax.eigen.quality import indistinct
from hks_jax.eigen.solver import Eigensolver, RawPairs, Report, silent
from hks_jax.fem.pencil import AnyPencil, Pencil
from hks_jax.linear import lapack
from hks_jax.linear.linear_map import first_order_only, with_transpose
from hks_jax.linear.loops import one_by_one
from hks_jax.linear.operators import Operator
from hks_jax.linear.pencil import SymmetricPencil
from hks_jax.linear.products import inner_products, matmul
from hks_jax.traced import is_traced

Telling = Literal["nothing", "warning", "error"]
"""The action if the linear solves of a derivative do not converge, in addition to the result NaN."""

_ON_HOST = 1 << 23
"""The largest size of the eigenvectors for which NumPy differentiates, as fast as JAX and without compilation."""

Lowest = tuple[Float[Array, " k"], Float[Array, "k n_dof"], Float[Array, "k n_dof"]]
Followed = tuple[
    Float[Array, " k"], Float[Array, "k n_dof"], Float[Array, "k n_dof"], Float[Array, ""], Float[Array, ""]
]


@partial(jax.custom_jvp, nondiff_argnums=(0, 2, 3, 4, 5, 6))
def solved(
    solver: Eigensolver,
    pencil: SymmetricPencil,
    k: int,
    extra: int,
    interior: bool,
    throw: bool,
    report: Report = silent,
) -> Followed:
    """Return k eigenvalues, their eigenvectors, the frame (the same vectors), the next eigenvalue, and a bound.

    The pairs are the lowest or, if ``interior``, the first above the origin of a `LocatedPencil`. The derivative of the
    frame is that of the eigenvectors without their rotation among the k. The next eigenvalue is infinite unless
    ``extra`` = 1; the bound is the solver's certificate. Derivatives treat these two as constants. A derivative that
    does not converge is NaN, with an error if ``throw``, and otherwise a warning if values are concrete.
    """
    values, vectors, complete_below = _computed(solver, pencil, k, extra, interior, report)
    values, vectors, following = _cut(values, vectors, k)
    return values, vectors, vectors, following, complete_below


# Let fᵢ = (dK − λᵢ dM) φᵢ, called the force. From Kφᵢ = λᵢMφᵢ and φᵢᵀMφⱼ = δᵢⱼ it follows that
#
#     dλᵢ = φᵢᵀfᵢ,    dφᵢ = −½ (φᵢᵀ dM φᵢ) φᵢ + Σ_{j≠i} φⱼ (φⱼᵀfᵢ)/(λᵢ − λⱼ).
#
# The sum is over all j. Its part over the computed pairs is evaluated directly. The remainder xᵢ is the solution of
#
#     (K − λᵢM) xᵢ = −Q fᵢ,   Φᵀ M xᵢ = 0,   Q = I − MΦΦᵀ,
#
# on the M-orthogonal complement of the computed Φ, where K − λᵢM is positive definite. Reverse mode uses the symmetry
# of the map fᵢ ↦ xᵢ. The solver computes some guard pairs beyond k, so that λᵢ has a distance from the eigenvalues on
# the complement. In the interior of a spectrum, the complement has eigenvalues on both sides, and so there are guards
# on both sides: at most half of them lie below the origin, and the others follow the k pairs.
#
# Within a multiple eigenvalue, the coefficient of φⱼ in dφᵢ (j ≠ i, λᵢ = λⱼ) is a gauge, because every basis of the
# eigenspace is valid. The rule sets it to −½ φⱼᵀ dM φᵢ, which keeps Φ M-orthonormal and is never NaN. If a gap is below
# √ε (λ − λ₀), where λ₀ is the lowest computed eigenvalue, the rule does the same, because division by such a gap would
# lose all digits. So dφᵢ is a derivative only if λᵢ is simple; of the dλᵢ of equal eigenvalues, only the sum has a
# meaning. Quantities that are independent of the basis, such as spectral functions, must not use this gauge, and
# `of_simple` hides the gauge from users. Such quantities use the frame instead: its derivative contains only the sum
# over j > k, which is the same for every basis of the first k eigenvectors (hks_jax/signatures/spectral_functions.py).
@solved.defjvp
def _solved_jvp(
    solver: Eigensolver,
    k: int,
    extra: int,
    interior: bool,
    throw: bool,
    report: Report,
    primals: tuple[SymmetricPencil],
    changes: tuple[SymmetricPencil],
) -> tuple[Followed, Followed]:
    pencil, change = first_order_only(primals[0]), changes[0]
    n_dof, sides = pencil.size, 2 if interior else 1
    spare = max(extra, min(sides * solver.guards(k, n_dof), min(solver.max_pairs(n_dof), n_dof) - k))
    values, vectors, complete_below = _computed(solver, pencil, k, spare, interior, report)
    adjoint = InteriorAdjoint(solver.adjoint.tolerance) if interior else solver.adjoint
    quiet = is_traced(primals) or adjoint.warns
    telling: Telling = "error" if throw else "nothing" if quiet else "warning"
    prepared = prepare(adjoint, k, pencil, values)
    eigenvalues, functions, following = _cut(values, vectors, k)
    known = prepared, _matrices(pencil), change, values, vectors, functions
    tangents = tangents_of(adjoint, telling, *known)
    constants = following if extra else jnp.full_like(following, jnp.inf), complete_below
    return (eigenvalues, functions, functions, *constants), (*tangents, *map(jnp.zeros_like, constants))


# Reverse mode stores all arrays of the arguments, even unused ones.
def _matrices(pencil: SymmetricPencil) -> SymmetricPencil:
    """Return the pencil without its metric, which only estimates need."""
    if not isinstance(pencil, Pencil) or pencil.metric is None:
        return pencil
    return eqx.tree_at(lambda p: p.metric, pencil, None)


def _computed(
    solver: Eigensolver, pencil: SymmetricPencil, k: int, spare: int, interior: bool, report: Report
) -> RawPairs:
    """Return k + spare computed pairs, and the bound of the solver."""
    if interior:
        return one_by_one(first_from_origin, (solver, k, spare, report), pencil)
    values, vectors, bound = one_by_one(_lowest, (solver, k + spare, report), pencil)
    values, vectors = _exact_null_modes(pencil, values, vectors) if pencil.n_null else (values, vectors)
    return values, vectors, bound


@numpy_where_known(static_argnums=2)
def _cut(xp: Any, values: Any, vectors: Any, k: int) -> tuple[Any, Any, Any]:
    """Return the first k pairs, and the next eigenvalue, or infinity if there is none."""
    return values[:k], vectors[:k], values[k] if len(values) > k else xp.asarray(xp.inf, values.dtype)


# A separate function, so that many products with one Jacobian share its result.
def prepare(adjoint: Adjoint, k: int, pencil: SymmetricPencil, values: Float[Array, " p"]) -> Any:
    """Call the adjoint's `prepare` for the first k of p computed pairs; return None if no linear solve is needed."""
    return one_by_one(_prepare, (adjoint, k), pencil, values) if _solves(pencil, k, len(values)) else None


def _solves(pencil: SymmetricPencil, k: int, p: int) -> bool:
    """Return whether derivatives of the first k of p pairs have components along other eigenvectors."""
    return p < pencil.size and pencil.n_fixed < k


def _shapes(*args: Any) -> tuple[Any, Any, Any]:
    """Return the shapes and dtypes of the tangents."""
    functions = args[-1]
    return jax.ShapeDtypeStruct((len(functions),), functions.dtype), functions, functions


def _numpy_rule(known: list[Any], x: list[Any] | None, y: list[Any] | None) -> Any:
    """Return the tangents or, given cotangents y, the cotangents of the change, by NumPy."""
    adjoint, telling, prepared, pencil, _, *pairs = known
    values, vectors, functions = map(np.asarray, pairs)
    if vectors.size > _ON_HOST or x is None:
        return None
    change, k = x[4], len(functions)
    eigenvalues, guards = values[:k, None], vectors[k:]
    apart, inverse = _gaps(np, values, k, np.asarray(indistinct(pencil, values.dtype)))

    def outside(rhs: np.ndarray) -> np.ndarray:
        if not _solves(pencil, k, len(values)):
            return np.zeros_like(rhs)
        free = np.arange(k)[:, None] >= pencil.n_fixed
        solution = np.asarray(_solve(adjoint, prepared, pencil, *pairs[:2], jax.device_put(np.where(free, rhs, 0))))
        if np.isnan(solution).any():
            _told(telling, jax.device_put(solution))
        return np.where(free, solution, 0)

    def onto(force: np.ndarray) -> np.ndarray:
        return (inverse[:, k:] * (force @ guards.T)) @ guards - outside(force)

    if y is None:
        moved = (change.mass.to_scipy() @ functions.T).T
        force = (change.stiffness.to_scipy() @ functions.T).T - eigenvalues * moved
        into, frame = force @ functions.T, onto(force)
        within = np.where(apart[:, :k], inverse[:, :k] * into, -(moved @ functions.T) / 2)
        return np.diagonal(into), within @ functions + frame, frame
    # The transpose of the computation above.
    of_values, of_vectors, of_frame = y
    within = of_vectors @ functions.T
    into = np.where(apart[:, :k], inverse[:, :k] * within, 0) + np.diag(of_values)
    force = into @ functions + onto(of_vectors + of_frame)
    moved = np.where(apart[:, :k], 0, -within / 2) @ functions - eigenvalues * force
    return change_of(change, functions, force, moved)


def change_of(
    change: SymmetricPencil, x: Float[np.ndarray, "b n_dof"], *p: Float[np.ndarray, "b n_dof"]
) -> SymmetricPencil:
    """Return the cotangent of the change: Σ pxᵀ for stiffness and mass, each with its own p, and zeros elsewhere."""
    zeros = jax.tree.map(lambda like: jax.device_put(np.zeros(like.shape, like.dtype)), change)
    matrices = tuple(matrix.outer(each, x) for matrix, each in zip((zeros.stiffness, zeros.mass), p, strict=True))
    return eqx.tree_at(lambda pencil: (pencil.stiffness, pencil.mass), zeros, matrices)


def _gaps(xp: Any, values: Any, k: int, rounding: Any) -> tuple[Any, Any]:
    """Return the mask (k, p) of distinct pairs λᵢ, λⱼ (i ≤ k), and 1/(λᵢ − λⱼ), or 0 if they count as equal."""
    gap, above = values[:k, None] - values[None], values - xp.nanmin(values)
    least = xp.sqrt(xp.finfo(values.dtype).eps) * xp.maximum(above[:k, None], above[None])
    apart = xp.abs(gap) > xp.maximum(least, rounding)
    return apart, xp.where(apart, 1 / xp.where(apart, gap, 1), 0)


# Without the checkpoint, reverse mode would store copies of the eigenvectors.
@jit_quickly(static_argnames=("adjoint", "telling"), linear=("change",), shapes=_shapes, numpy_rule=_numpy_rule)
@partial(jax.checkpoint, static_argnums=(0, 1))
def tangents_of(
    adjoint: Adjoint,
    telling: Telling,
    prepared: Any,
    pencil: SymmetricPencil,
    change: SymmetricPencil,
    values: Float[Array, " p"],
    vectors: Float[Array, "p n_dof"],
    functions: Float[Array, "k n_dof"],
) -> Lowest:
    """Return dλ, dφ and the derivative of the frame for the first k of p computed pairs.

    ``prepared`` is the result of `prepare` for the pairs in this order. ``functions`` are the first k vectors again,
    which saves a copy.
    """
    k = len(functions)
    eigenvalues, guards = values[:k], vectors[k:]
    moved = change.mass.apply(functions)
    force = change.stiffness.apply(functions) - eigenvalues[:, None] * moved
    apart, inverse = _gaps(jnp, values, k, indistinct(pencil, values.dtype))
    # The guards have a separate product, because reverse mode of the frame needs only this one.
    into = inner_products(functions, force)
    within = jnp.where(apart[:, :k], inverse[:, :k] * into, -inner_products(functions, moved) / 2)
    frame = _onto(guards, inverse[:, k:], force)
    if _solves(pencil, k, len(values)):
        frame = frame + _outside(adjoint, telling, prepared, pencil, values, vectors, -force)
    d_vectors = matmul(within, functions) + frame
    return jnp.diagonal(into), d_vectors, frame


# This symmetric map is its own transpose. The transpose derived by JAX would be several times slower.
def _onto(
    guards: Float[Array, "g n_dof"], factors: Float[Array, "k g"], force: Float[Array, "k n_dof"]
) -> Float[Array, "k n_dof"]:
    """Return Σⱼ cᵢⱼ (gⱼ·fᵢ) gⱼ."""

    def onto(force: Float[Array, "k n_dof"]) -> Float[Array, "k n_dof"]:
        return matmul(factors * inner_products(guards, force), guards)

    return with_transpose(onto, onto, force)


def _outside(
    adjoint: Adjoint,
    telling: Telling,
    prepared: Any,
    pencil: SymmetricPencil,
    values: Float[Array, " p"],
    vectors: Float[Array, "p n_dof"],
    rhs: Float[Array, "k n_dof"],
) -> Float[Array, "k n_dof"]:
    """Solve (K − λᵢM) xᵢ = Q rhsᵢ on the complement of the p computed eigenvectors."""
    shifts, n_fixed = values[: len(rhs), None], pencil.n_fixed

    def matvec(x: Float[Array, "k n_dof"]) -> Float[Array, "k n_dof"]:
        return pencil.stiffness.apply(x) - shifts * pencil.mass.apply(x)

    def solve(_: object, b: Float[Array, "k n_dof"]) -> Float[Array, "k n_dof"]:
        return _told(telling, one_by_one(_solve, (adjoint,), prepared, pencil, values, vectors, b))

    # The force is zero on null vectors that every perturbation annihilates. In reverse mode, these rows are cotangents;
    # then their solutions are set to zero.
    def moved(x: Float[Array, "k n_dof"]) -> Float[Array, "k n_dof"]:
        return jnp.where(np.arange(len(x))[:, None] < n_fixed, 0, x)

    return moved(jax.lax.custom_linear_solve(matvec, moved(rhs), solve, symmetric=True))


# `one_by_one` needs the same function object in every call; so these are module functions, not methods.
def _lowest(solver: Eigensolver, k: int, report: Report, pencil: SymmetricPencil) -> RawPairs:
    return solver.lowest(pencil, k, report)


def _prepare(adjoint: Adjoint, k: int, pencil: SymmetricPencil, values: Float[Array, " p"]) -> Any:
    return adjoint.prepare(pencil, values, k)


def _solve(adjoint: Adjoint, *args: Any) -> Float[Array, "k n_dof"]:
    return adjoint.solve(*args)


def _told(telling: Telling, x: Float[Array, "k n_dof"]) -> Float[Array, "k n_dof"]:
    """Return x; if rows of x are NaN, warn or raise."""
    failed = jnp.sum(jnp.any(jnp.isnan(x), axis=1))
    if telling == "error":
        return eqx.error_if(x, failed > 0, unsolved("some", len(x)))
    if telling == "warning":

        def warn(failed: Array | np.ndarray) -> np.ndarray:
            if failed:
                warn_of_accuracy(unsolved(int(failed), len(x)))
            return np.zeros((), x.dtype)

        return x + jax.pure_callback(warn, jax.ShapeDtypeStruct((), x.dtype), failed, vmap_method="sequential")
    return x


def _exact_null_modes(
    pencil: SymmetricPencil, values: Float[Array, " k"], vectors: Float[Array, "k n_dof"]
) -> tuple[Float[Array, " k"], Float[Array, "k n_dof"]]:
    """Replace the solver's approximations of the null vectors by the known null vectors.

    Their eigenvalue becomes exactly 0 instead of about ±1e-13. Other vectors become orthogonal to the null vectors.
    """
    if not known_and_few((pencil.mass, values, vectors)):
        return _exact_by_jax(pencil, values, vectors)
    assert pencil.null_space is not None
    mass = pencil.mass.to_scipy()

    def inverse_cholesky(matrix: np.ndarray) -> np.ndarray:
        return np.linalg.inv(np.linalg.cholesky(matrix))

    by_scipy = partial(_with_null_modes, np, lambda rows: (mass @ rows.T).T, inverse_cholesky)
    return by_numpy(by_scipy, pencil.null_space.vectors, values, vectors)


@jit_quickly()
def _exact_by_jax(
    pencil: SymmetricPencil, values: Float[Array, " k"], vectors: Float[Array, "k n_dof"]
) -> tuple[Float[Array, " k"], Float[Array, "k n_dof"]]:
    assert pencil.null_space is not None
    # The barrier prevents XLA from folding long constants during compilation.
    nulls = jax.lax.optimization_barrier(pencil.null_space.vectors)
    return _with_null_modes(jnp, pencil.mass.apply, lapack.inverse_cholesky, nulls, values, vectors)


def _with_null_modes(
    xp: Any, mass: Callable[[Any], Any], inverse_cholesky: Callable[[Any], Any], nulls: Any, values: Any, vectors: Any
) -> tuple[Any, Any]:
    product = np.matmul if xp is np else partial(jnp.matmul, precision="highest")
    nulls = nulls[: values.size]
    image = mass(nulls)
    lengths = xp.sqrt(xp.sum(nulls * image, axis=1, keepdims=True))
    nulls, image = nulls / lengths, image / lengths
    orthonormal = inverse_cholesky(product(nulls, image.T))
    nulls, image = product(orthonormal, nulls), product(orthonormal, image)
    share = product(vectors, image.T)
    vectors = vectors - product(share, nulls)
    vectors = vectors / xp.sqrt(1 - xp.sum(share * share, axis=1, keepdims=True))
    n_null = len(nulls)
    return xp.concatenate([xp.zeros_like(values[:n_null]), values[n_null:]]), xp.concatenate([nulls, vectors[n_null:]])


@jax.custom_jvp
def frame_of_chosen(
    vectors: Float[Array, "k n_dof"], mass: Operator, chosen: Bool[Array, " k"]
) -> Float[Array, "k n_dof"]:
    """Return the vectors, whose derivative excludes rotations among the chosen ones (a frame of the chosen vectors).

    A frame of all vectors would also exclude rotations towards vectors that are not chosen.
    """
    return vectors


@frame_of_chosen.defjvp
def _frame_of_chosen_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    vectors, mass, chosen = first_order_only(primals)
    change = tangents[0]
    inside = jnp.where(chosen, products_with_constants(mass.apply(change), vectors), 0)
    return vectors, change - matmul(inside, vectors)


# The transpose derived by JAX would multiply by the transposed vectors, which takes twice as long.
def products_with_constants(images: Float[Array, "b n_dof"], vectors: Float[Array, "k n_dof"]) -> Float[Array, "b k"]:
    """Return the inner products, for derivatives linear in the images; the vectors are constants."""
    return with_transpose(partial(inner_products, vectors), lambda mix: matmul(mix, vectors), images)


@jax.custom_jvp
def of_simple(
    vectors: Float[Array, "k n_dof"],
    values: Float[Array, " k"],
    following: Float[Array, ""],
    kept: Bool[Array, " k"],
    part: Int[Array, " k"] | None,
    pencil: AnyPencil,
) -> Float[Array, "k n_dof"]:
    """Return the vectors. Their nonzero derivatives become NaN unless the eigenvalue is simple and kept."""
    return vectors


# The derivative of Σᵢ f(λᵢ) φᵢ(x)² contains Gᵢⱼ f'(λ) φᵢ φⱼ for equal eigenvalues λᵢ = λⱼ = λ. The derivatives of the
# f(λᵢ) give only the diagonal terms. Rotations among these φᵢ cancel, because the f(λᵢ) are equal. So no finite dφᵢ
# makes the sum correct.
@of_simple.defjvp
def _of_simple_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    vectors, values, following, kept, part, pencil = primals
    rounding = [indistinct(each, values.dtype) for each in pencil.parts]
    multiple = _is_multiple(values, following, kept, part, rounding, pencil.parts[0].n_fixed > 0)

    def undefined(x: Float[Array, "k n_dof"]) -> Float[Array, "k n_dof"]:
        counts = jnp.any(x != 0, axis=1)
        return jnp.where((multiple & counts)[:, None], jnp.nan, x)

    return vectors, with_transpose(undefined, undefined, tangents[0])


@numpy_where_known(static_argnums=5)
def _is_multiple(
    xp: Any, values: Any, following: Any, kept: Any, part: Any | None, rounding: list[Any], fixed: bool
) -> Any:
    """Return the mask (k) of pairs that are not kept, cut by k, or mixed with an equal eigenvalue by perturbations."""
    size = xp.maximum(xp.abs(values), values - values[:1])
    least = xp.maximum(xp.finfo(values.dtype).eps ** 0.5 * size, xp.max(xp.stack(rounding)))
    near = xp.abs(values[:, None] - values[None]) <= least[:, None]
    if part is not None:
        near &= part[:, None] == part[None]
    mixed = (xp.sum(near, axis=1) > 1) & ~((values == 0) & fixed)  # perturbations do not change fixed null vectors
    return mixed | (following - values <= least) | ~kept
