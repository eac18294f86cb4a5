"""Factorised symmetric matrices. Solves, determinant and inverse are differentiable with respect to matrix entries."""

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from hks_jax.accuracy import warn_of_accuracy
from hks_jax.arrays import Scalar, jax_array
from hks_jax.checks import real_array
from hks_jax.linear.dissection import Dissection, dissect
from hks_jax.linear.multifrontal import Factorisation, Trial, eliminate, factorise, try_out
from hks_jax.linear.operators import DiagonalOperator, OfColumns, PatternedOperator
from hks_jax.linear.selected_inversion import Eliminated, inverse_entries, selected
from hks_jax.linear.symmetric_inverse import symmetric_inverses
from hks_jax.linear.symmetric_pencil import SymmetricPencil, tabulated
from hks_jax.traced import is_traced

_PROBES = 4
"""The number of random right-hand sides that test a factorisation."""
_LEAST_PIVOT = 0.375
"""The least pivot of a second factorisation is ε to this power, relative to the front's entries."""
_DOUBTFUL = 0.01
"""The estimated error of a determinant or an inverse above which a warning is issued."""
_BACKWARD = 4
"""The backward error, in units of ε, at which refinement of solutions stops."""
_NULL = 1000
"""Error messages count singular values as zero if they are at most this number times ε‖A‖."""
_SEARCHED, _TURNS = 16, 4
"""The largest number of null vectors that an error message reports, and the number of iterations that compute them."""


Columns = Float[Array, "n m"]


class Inertia(NamedTuple):
    """The numbers of negative and of positive eigenvalues; −1 if they are uncertain."""

    negative: Int[Array, "..."]
    positive: Int[Array, "..."]


class FactorisedMatrix(eqx.Module):
    """A symmetric matrix A = LDLᵀ, factorised once; a pytree. See `hks_jax.factorise`.

    Attributes:
        matrix: A. Derivatives of any order with respect to its entries exist, forward and reverse.
        factor: LDLᵀ. Derivatives treat the factorisation as a constant.
        sound: whether the factorisation passes a test with random right-hand sides. If the test is passed, LDLᵀ has the
            inertia of A, and iterative refinement of solutions converges. If the test fails, results are NaN.
        error: an estimate of ‖I − AF⁻¹‖ in the Frobenius norm, where F is the computed LDLᵀ. This estimate also holds
            for the error of log|det A| and the relative error of A⁻¹. If small pivots were replaced, the estimate is
            infinite, and log|det A| and A⁻¹ are NaN. Solutions are more accurate than A⁻¹, because they are refined.
    """

    matrix: PatternedOperator
    factor: Factorisation
    sound: Bool[Array, ""]
    error: Scalar

    def __repr__(self) -> str:
        return f"FactorisedMatrix(size={self.size}, dtype={self.matrix.dtype})"

    @property
    def size(self) -> int:
        """The number of rows, n."""
        return self.matrix.size

    @property
    def inertia(self) -> Inertia:
        """The numbers of negative and positive eigenvalues; if A = K − σM, of pencil eigenvalues below and above σ."""
        negative = self.factor.negative
        counts = negative, jnp.asarray(self.size, negative.dtype) - negative
        return Inertia(*(jnp.where(self.sound, count, -1) for count in counts))

    @property
    def sign(self) -> Scalar:
        """The sign of the determinant, ±1; NaN if it is uncertain."""
        return _nan_unless(self.sound, (1 - 2 * (self.factor.negative % 2)).astype(self.matrix.dtype))

    def solve(self, b: Float[Array | np.ndarray, "n *m"]) -> Float[Array, "n *m"]:
        """Solve A x = b for a vector (n,) or the columns of a block (n, m), with a backward error at rounding level.

        Raises:
            ValueError: b has another shape, or is complex.
        """
        b = real_array("b", b).astype(self.matrix.dtype)
        if b.ndim not in (1, 2) or b.shape[0] != self.size:
            raise ValueError(f"b: got shape {b.shape}; expected ({self.size},) or ({self.size}, m)")
        x = _solve(self.matrix, jax.lax.stop_gradient(self.factor), b.reshape(self.size, -1)).reshape(b.shape)
        return _nan_unless(self.sound, x)

    def logdet(self) -> Scalar:
        """Return log|det A|; `sign` is the sign of det A.

        Raises:
            ValueError: pivots were replaced, and values are concrete.

        Warns:
            AccuracyWarning: `error` exceeds 0.01.
        """
        return self._unless_replaced(_log_determinant)

    def inverse_diagonal(self) -> Float[Array, " n"]:
        """Return the diagonal of A⁻¹ by selected inversion, which takes about as long as the factorisation.

        Raises:
            ValueError: pivots were replaced, and values are concrete.

        Warns:
            AccuracyWarning: `error` exceeds 0.01.
        """
        return self._unless_replaced(_inverse_diagonal)

    def _unless_replaced(self, function: Callable[[Array, Factorisation], Array]) -> Array:
        if not is_traced(self.error) and self.sound:
            if jnp.isinf(self.error):
                raise ValueError(
                    "matrix: got a nonsingular A, but the elimination inverts a block that is singular or nearly "
                    "singular. Solutions are accurate, but the determinant and the inverse are not. Shift A slightly"
                )
            if self.error > _DOUBTFUL:
                warn_of_accuracy(
                    f"matrix: rounding in {self.matrix.dtype} causes an error of about {float(self.error):.1g} in "
                    "log|det A|, and the same relative error in the inverse. Use float64, or shift A slightly"
                )
        return _nan_unless(jnp.isfinite(self.error), function(self.matrix.flat(), jax.lax.stop_gradient(self.factor)))


def _nan_unless(certain: Bool[Array, ""], x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Return x if ``certain``, otherwise NaN with NaN derivatives; `jnp.where` would make these derivatives zero."""
    return x * jnp.where(certain, 1.0, jnp.nan).astype(x.dtype)


def factorised(matrix: PatternedOperator, name: str = "matrix") -> FactorisedMatrix:
    """Factorise a symmetric matrix A. Of two entries that are equal by symmetry, only one is read.

    Raises:
        ValueError: A is concrete, and singular or not finite. The message begins with ``name``.
    """
    ones = jnp.ones(matrix.size, matrix.dtype)
    pencil = tabulated(SymmetricPencil(matrix, DiagonalOperator(ones)))
    constant = jax.lax.stop_gradient(pencil)
    dissection = jax.tree.map(jax_array, dissect(matrix.pattern))
    factor, trial, tries = certain_factorisation(dissection, constant, jnp.zeros((), matrix.dtype))
    if not is_traced(trial) and not trial.sound:
        raise ValueError(_failure(name, constant, factor))
    # For any matrix E and a random unit vector v, ‖Ev‖ is about the Frobenius norm of E divided by √n.
    error = jnp.where(trial.sound & (tries == 1), trial.rate * math.sqrt(matrix.size), jnp.inf)
    return FactorisedMatrix(pencil.stiffness, factor, trial.sound, error)


def certain_factorisation(
    dissection: Dissection, pencil: SymmetricPencil, shift: Scalar
) -> tuple[Factorisation, Trial, Int[Array, ""]]:
    """Factorise K − σM, and again with small pivots replaced if necessary; return factors, `Trial`, number of tries."""
    probes = jax.random.normal(jax.random.key(0), (pencil.size, _PROBES), shift.dtype)
    bounded, matrix = float(jnp.finfo(shift.dtype).eps) ** _LEAST_PIVOT, pencil.shifted(shift)

    def attempt(tries: Int[Array, ""]) -> tuple[Any, Trial]:
        least = jnp.where(tries > 0, bounded, 0).astype(shift.dtype)
        factor = factorise(dissection, matrix, least)
        return factor.arrays, try_out(factor, pencil, shift, probes)

    none = jnp.zeros((), int)
    if is_traced((pencil, shift, none)):
        # With `while_loop`, the factorisation is compiled only once for both tries.
        start = jax.tree.map(lambda like: jnp.zeros(like.shape, like.dtype), jax.eval_shape(attempt, none))
        tries, (arrays, trial) = jax.lax.while_loop(
            lambda s: (s[0] < 2) & ~s[1][1].sound, lambda s: (s[0] + 1, attempt(s[0])), (none, start)
        )
    else:
        tries, (arrays, trial) = none + 1, attempt(none)
        if not trial.sound:
            tries, (arrays, trial) = none + 2, attempt(none + 1)
    return Factorisation(dissection, *arrays), trial, tries


def _failure(name: str, pencil: SymmetricPencil, factor: Factorisation) -> str:
    """Return the reason why a matrix could not be factorised, given the factorisation with small pivots replaced."""
    entries = np.asarray(pencil.stiffness.triplets()[0])
    wrong = int((~np.isfinite(entries)).sum())
    if wrong:
        return f"{name}: {wrong} of {entries.size} entries are NaN or infinite; expected finite numbers"
    # x ↦ x − F⁻¹Ax preserves null vectors of A, and reduces other vectors to the relative error of F.
    product, norm = pencil.stiffness.of_columns(), max(float(_norm(pencil.stiffness)), np.finfo(entries.dtype).tiny)
    size = min(_SEARCHED, pencil.size)
    x = np.random.default_rng(0).standard_normal((pencil.size, size)).astype(entries.dtype)
    for _ in range(_TURNS):
        x = np.linalg.qr(np.nan_to_num(np.asarray(x - factor.solve(product(jnp.asarray(x))))))[0]
    sizes = np.linalg.svd(np.asarray(product(jnp.asarray(x))), compute_uv=False) / norm
    null = sizes <= _NULL * np.finfo(entries.dtype).eps
    if not null.any():
        return (
            f"{name}: got a matrix that is singular within rounding of {entries.dtype} (‖Av‖ ≤ {sizes.min():.1e} ‖A‖ "
            "‖v‖ for some v), or needs pivoting. Shift the matrix, scale rows and columns, or use float64"
        )
    many = f"{'at least ' if null.all() and size < pencil.size else ''}{null.sum()}"
    return (
        f"{name}: got a singular matrix with {many} null vector(s), ‖Av‖ ≤ {sizes[null].max():.1e} ‖A‖ ‖v‖. Shift "
        "the matrix, fix as many unknowns as null vectors, or add a term that is definite on the null space"
    )


@jax.jit
def _norm(matrix: PatternedOperator) -> Scalar:
    """Return the maximum norm, the largest row sum of absolute values."""
    ones = jnp.ones((matrix.size, 1), matrix.dtype)
    return jnp.max(matrix.with_flat(jnp.abs(matrix.flat())).of_columns()(ones))


# If A x = b, then A dx = db − dA x. JAX derives all derivatives of a linear solve from the product with A. The solution
# method does not enter these derivatives.
@jax.jit
def _solve(matrix: PatternedOperator, factor: Factorisation, b: Columns) -> Columns:
    product, norm = matrix.of_columns(), jax.lax.stop_gradient(_norm(matrix))
    return jax.lax.custom_linear_solve(product, b, partial(_refined, factor, norm), symmetric=True)


def _refined(factor: Factorisation, norm: Scalar, product: OfColumns, b: Columns) -> Columns:
    """Solve with iterative refinement, as long as each step at least halves the largest backward error."""
    finfo = jnp.finfo(b.dtype)

    def largest(x: Array) -> Float[Array, " m"]:
        return jnp.max(jnp.abs(x), axis=0)

    def measured(x: Array) -> tuple[Array, Array, Scalar]:
        rest = b - product(x)
        return x, rest, jnp.max(largest(rest) / (norm * largest(x) + largest(b) + finfo.tiny))

    def again(state: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        x, rest, error, _ = state
        new = measured(x + factor.solve(rest))
        x, rest, least = (jnp.where(new[2] < error, *both) for both in zip(new, state[:3], strict=True))
        return x, rest, least, least < error / 2

    def goes_on(state: tuple[Array, Array, Array, Array]) -> Bool[Array, ""]:
        return (state[2] > _BACKWARD * finfo.eps) & state[3]

    return jax.lax.while_loop(goes_on, again, (*measured(factor.solve(b)), jnp.ones((), bool)))[0]


def _eliminated(matrix: Float[Array, " m"], factor: Factorisation) -> Eliminated:
    """Return the result of `eliminate`: from the factors or, if solves use a merged tree, by a second elimination."""
    tree = factor.dissection
    if tree.merged is not None:
        return eliminate(tree, matrix, lambda blocks, _: symmetric_inverses(blocks)[0])
    sizes = [level.shape[2] for level in tree.levels]
    return [(both[:, :s], both[:, s:]) for s, both in zip(sizes, factor.downward, strict=True)]


# Only selected entries of d(A⁻¹) = −A⁻¹ dA A⁻¹ are needed. The derivative rule differentiates both steps of selected
# inversion: the elimination, and the recursion from the first separator to the cells. The transposed rule takes a few
# times as many operations as the inversion. The values of A⁻¹ come from the factors of A.
@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _inverse(diagonal: bool, matrix: Float[Array, " m"], factor: Factorisation) -> Float[Array, " n"]:
    return selected(factor.dissection, _eliminated(matrix, factor), diagonal)


@_inverse.defjvp
def _inverse_jvp(diagonal: bool, primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    matrix, factor = primals
    tangent = jax.jvp(lambda matrix: inverse_entries(factor.dissection, matrix, diagonal), (matrix,), tangents[:1])[1]
    return _inverse(diagonal, matrix, factor), tangent


@jax.custom_jvp
def _log_of_pivots(matrix: Float[Array, " m"], factor: Factorisation) -> Scalar:
    return jnp.sum(jnp.log(jnp.abs(factor.pivots)))


# The derivative d log|det A| = tr(A⁻¹ dA) = Σ (A⁻¹)ᵢⱼ dAᵢⱼ needs the entries of A⁻¹ on the sparsity pattern of A. The
# dissection lists only one of two equal entries that couple an own node to a boundary node; this entry counts twice.
@_log_of_pivots.defjvp
def _log_of_pivots_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    (matrix, factor), (change, _) = primals, tangents
    tree = factor.dissection
    times = [np.where(np.arange(h) < s, 1, 2)[None, :, None] for _, h, s in (level.shape for level in tree.levels)]
    weights = [jnp.broadcast_to(t, level.shape).reshape(-1) for t, level in zip(times, tree.levels, strict=True)]
    weighted = _inverse(False, matrix, factor) * jnp.concatenate(weights).astype(matrix.dtype)
    slope = weighted.at[tree.places].get(mode="fill", fill_value=0, wrap_negative_indices=False)
    listed = change if tree.entries is None else change[tree.entries]
    return _log_of_pivots(matrix, factor), jnp.vdot(slope, listed)


_log_determinant = jax.jit(_log_of_pivots)
_inverse_diagonal = jax.jit(partial(_inverse, True))
