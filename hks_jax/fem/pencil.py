"""The matrix pencil of an operator on a domain: what is known of it, and how the matrices of elements become one."""

from functools import lru_cache
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from hks_jax.fem.fields import Field
from hks_jax.fem.forms import WeakForm
from hks_jax.fem.resolution import Resolution, SampledMetric, resolution_of
from hks_jax.fem.space import FunctionSpace, MeshSpace, VectorSpace
from hks_jax.linear.operators import DiagonalOperator, Operator, PatternedOperator, SparseOperator
from hks_jax.linear.pattern import SparsePattern
from hks_jax.linear.pencil import NullSpace, SymmetricPencil
from hks_jax.traced import is_staged


class Pencil(SymmetricPencil):
    """The stiffness K and mass M ≻ 0 of functions on a domain, or on the nodes of matrices from elsewhere.

    Attributes:
        stiffness: K; multiply with ``@``, or take ``.to_scipy()``, ``.to_dense()``.
        mass: M, likewise.
        metric: that of the domain, for estimates; None where it is not known.
        volume: the area or volume of the domain in the units of the metric, eliminated nodes included; None where it is
            not known.
        space: the space of the functions.
        null_space: that of K ⪰ 0; None where nothing is known, and K may be indefinite.
        lower_bound: a number below which there is no eigenvalue, where that is known of a K that may be indefinite;
            constant to derivatives.
        row_sums: (n_dof,) those of M, eliminated columns included, where values at nodes are read with them, infinite
            where these are 0; None where the unknowns are the values at nodes.
    """

    metric: SampledMetric | None
    volume: Float[Array, ""] | None
    space: FunctionSpace = eqx.field(static=True)
    lower_bound: Float[Array, ""] | None = eqx.field(default=None, kw_only=True)
    row_sums: Float[Array, " n_dof"] | None = eqx.field(default=None, kw_only=True)

    def __repr__(self) -> str:
        return f"Pencil({self.space!r})"

    @property
    def bounded(self) -> bool:
        """Whether it is known where the spectrum begins."""
        return self.null_space is not None or self.lower_bound is not None

    @property
    def measured(self) -> bool:
        """Whether dimension and volume are known, as Weyl's law needs them."""
        return self.volume is not None and self.space.dimension is not None

    @property
    def resolution(self) -> Resolution | None:
        """What the spacing of the nodes does to signatures, for estimates; None where it is not known."""
        if self.metric is None:
            return None
        return resolution_of(
            self.metric, self.space, isinstance(self.mass, DiagonalOperator), self.row_sums is not None
        )

    def read(self, functions: Float[Array, "... n_dof"], part: Any = None) -> Float[Array, "... n_dof"]:
        """Return the values at the free nodes of functions that are given by their unknowns (`assemble`)."""
        return functions if self.row_sums is None else _read(self.mass, self.row_sums, functions)

    def integrals(self, values: Float[Array, "... n_dof"]) -> Float[Array, "... n_dof"]:
        """Return the functional ∫φu of values that are `read` from φ, for functions u given by theirs."""
        if self.row_sums is None:
            return self.mass.apply(values)
        return jnp.where(jnp.isinf(self.row_sums), 0, self.row_sums) * values

    def with_stiffness(self, stiffness: PatternedOperator) -> "Pencil":
        """Return the pencil of another operator on the same domain, such as K + V, of whose kernel nothing is known.

        ``pencil.with_stiffness(pencil.stiffness.plus(V))`` with V (n_dof,) adds a diagonal matrix.

        Raises:
            ValueError: a matrix of another pattern.
        """
        if stiffness.pattern != self.pattern:
            raise ValueError("stiffness: got a matrix with another pattern; use `sparse_pencil` for any two matrices")
        return Pencil(stiffness, self.mass, self.metric, self.volume, self.space, row_sums=self.row_sums)

    def counted_from(self, origin: Float[Array, ""]) -> "Pencil":
        """Return K − σM and M, σ a lower bound of the spectrum; of the null space nothing is known beforehand."""
        moved = self.stiffness.with_flat(self.shifted(origin))
        nothing = NullSpace(jnp.zeros((0, self.size), origin.dtype))
        return Pencil(moved, self.mass, self.metric, self.volume, self.space, null_space=nothing)

    @property
    def parts(self) -> tuple["Pencil", ...]:
        """The pencil itself: one problem."""
        return (self,)


@jax.jit
def _read(mass: Operator, row_sums: Float[Array, " n_dof"], functions: Float[Array, "... n_dof"]) -> Array:
    columns = functions.reshape(-1, mass.size).T
    return (functions + mass.of_columns()(columns).T.reshape(functions.shape) / row_sums) / 2


class MirrorPencil(eqx.Module):
    """The 2^m mixed Neumann/Dirichlet pencils of a domain doubled m times: reflected along axes, or along its rim.

    Their spectra united are the spectrum of the doubled domain. An eigenfunction of a part, divided by √2^m, is
    one of the doubled domain, restricted to the original.

    Attributes:
        parts: the mixed problems, the one that is Neumann everywhere first.
        including: for each part the parts whose functions include its own: some before it, and itself. By min–max no
            eigenvalue of a part is less than that of the same number of a part that includes it. So of the lowest
            eigenvalues of all parts, a part that c parts include has at most 1/c.
    """

    parts: tuple[Pencil, ...]
    including: tuple[tuple[int, ...], ...] = eqx.field(static=True)

    @property
    def measured(self) -> bool:
        """Whether dimension and volume are known."""
        return self.parts[0].measured

    @property
    def space(self) -> FunctionSpace:
        """The space of the all-Neumann part, which holds the functions of all parts."""
        return self.parts[0].space

    @property
    def resolution(self) -> Resolution | None:
        """What the spacing of the nodes does to signatures, for estimates."""
        return self.parts[0].resolution

    def read(self, functions: Float[Array, "k n_dof"], part: Int[Array, " k"] | None) -> Float[Array, "k n_dof"]:
        """Return the values at the free nodes of functions, of which each belongs to a part."""
        # Where both have unknowns, the mass of a part is that of the first; elsewhere its functions vanish.
        sums = [
            jnp.where(part.space.free, part.space.extend(part.row_sums, outside=0.0), jnp.inf)
            for part in self.parts
            if part.row_sums is not None
        ]
        if not sums:
            return functions
        whole = self.space.restrict(jnp.stack(sums))[part]
        return jnp.where(jnp.isinf(whole), 0, functions + self.parts[0].mass.apply(functions) / whole) / 2

    @property
    def volume(self) -> Float[Array, ""] | None:
        """The area or volume of the doubled domain."""
        return None if self.parts[0].volume is None else len(self.parts) * self.parts[0].volume


AnyPencil: TypeAlias = Pencil | MirrorPencil


def from_lower_bound(pencil: AnyPencil) -> tuple[AnyPencil, Float[Array, ""]]:
    """Return a pencil whose stiffness is not negative, and the origin that its eigenvalues count from, 0 or a bound."""
    bounds = [part.lower_bound for part in pencil.parts if part.lower_bound is not None]
    if not bounds:
        return pencil, jnp.zeros((), pencil.parts[0].stiffness.dtype)
    origin = jnp.min(jnp.stack(bounds))
    parts = tuple(part.counted_from(origin) for part in pencil.parts)
    return (MirrorPencil(parts, pencil.including) if isinstance(pencil, MirrorPencil) else parts[0]), origin


def assembled(
    stiffness: PatternedOperator,
    consistent: PatternedOperator,
    lumped: Float[Array, "*node_shape"],
    metric: SampledMetric | None,
    volume: Float[Array, ""],
    space: FunctionSpace,
    operator: WeakForm,
    fields: dict[str, Field],
) -> Pencil:
    """Return the pencil of K and M, which may be lumped to its row sums at all nodes, with what is known of it."""
    mass = DiagonalOperator(entries=space.restrict(lumped)) if operator.lumped else consistent
    if operator.own:
        return Pencil(stiffness, mass, None, None, space)
    nulls = bound = None
    if "potential" in fields:
        bound = _least(fields["potential"], space, operator)
    else:
        nulls = _constants(space, lumped)
    row_sums = space.restrict(lumped) if operator.cancelling else None
    known = stiffness, mass, metric, volume, space
    return Pencil(*known, null_space=nulls, lower_bound=bound, row_sums=row_sums)


# K = A + ∫ρV hᵢhⱼ with A ⪰ 0, and V is at least v at the quadrature points: K − vM ⪰ 0 for the mass of the same points.
# The lumped mass D ⪰ M is larger, so that there v may not be positive.
def _least(potential: Field, space: FunctionSpace, operator: WeakForm) -> Float[Array, ""] | None:
    """Return a lower bound of the spectrum; None where values between nodes may be less than those at them."""
    if potential.at == "nodes" and isinstance(space, MeshSpace) and space.degree == 2:
        return None
    least = jnp.min(jax.lax.stop_gradient(potential.values))
    return jnp.minimum(least, 0) if operator.lumped else least


def _constants(space: FunctionSpace, values: Array) -> NullSpace:
    """Return what every stiffness of a Laplace–Beltrami operator annihilates: constants on natural components."""
    n_null, labels, numbers = space.n_null, space.null_labels, jnp if is_staged() else np
    if n_null == 0 or (n_null == 1 and (labels == 0).all()):
        vectors = numbers.ones((n_null, space.n_dof), values.dtype)
    else:
        number = numbers.arange(n_null, dtype=np.int32)[:, None]
        vectors = (numbers.asarray(labels, np.int32) == number).astype(values.dtype)
    return NullSpace(jnp.asarray(vectors) if is_staged() else jax.device_put(vectors), fixed=True)


def gathered(space: MeshSpace | VectorSpace, matrices: Float[Array, "E m m"]) -> SparseOperator:
    """Add up the matrices of all elements."""
    where, slots, pattern = _sparse_pattern(space)
    return SparseOperator(jax.ops.segment_sum(matrices.reshape(-1)[where], slots, pattern.rows.size), pattern)


def row_sums_of(space: MeshSpace | VectorSpace, matrices: Float[Array, "E m m"]) -> Float[Array, "*node_shape"]:
    """Return the row sums at all nodes, those to eliminated nodes included."""
    sums = jnp.sum(matrices, axis=-1).ravel()
    return jax.ops.segment_sum(sums, space.cells.ravel(), space.free.size).reshape(space.node_shape)


@lru_cache(maxsize=16)
def _sparse_pattern(space: MeshSpace | VectorSpace) -> tuple[np.ndarray, np.ndarray, SparsePattern]:
    """Return which local entries count (both ends free), the matrix entry that each adds to, and the pattern."""
    n, corners = space.n_dof, space.cells.shape[1]
    cells = space.degrees_of_freedom[space.cells]
    rows, cols = np.repeat(cells, corners, axis=1).ravel(), np.tile(cells, (1, corners)).ravel()
    where = np.flatnonzero((rows >= 0) & (cols >= 0))
    keys, slots = np.unique(rows[where] * n + cols[where], return_inverse=True)
    return where, slots, SparsePattern(n, keys // n, keys % n)
