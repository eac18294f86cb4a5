"""The matrix pencil of an operator on a domain with its known properties, and its assembly from elements."""

from dataclasses import replace
from functools import lru_cache
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.arrays import jax_array
from hks_jax.fem.fields import Field
from hks_jax.fem.forms import WeakForm
from hks_jax.fem.resolution import Resolution, SampledMetric, resolution_of
from hks_jax.fem.space import FunctionSpace, MeshSpace, VectorSpace
from hks_jax.linear.operators import DiagonalOperator, Operator, PatternedOperator, SparseOperator
from hks_jax.linear.pattern import SparsePattern
from hks_jax.linear.symmetric_pencil import NullSpace, SymmetricPencil
from hks_jax.traced import is_staged

Inclusions = tuple[tuple[int, ...], ...]
"""See `MirrorPencil.including`."""


class Pencil(SymmetricPencil):
    """The stiffness K and the positive definite mass M of functions on a domain, or a pair of the user's matrices.

    Attributes:
        stiffness: K; multiply with ``@``, or convert with ``.to_scipy()`` or ``.to_dense()``.
        mass: M, with the same methods.
        metric: the metric of the domain, for error estimates; None if it is not known.
        volume: the area or volume of the domain in the units of the metric, including eliminated nodes, on which Weyl's
            law depends; None if it is not known.
        space: the space of the functions.
        null_space: the null space of a positive semidefinite K; None if it is not known, and then K may be indefinite.
        lower_bound: a lower bound of the spectrum, if one is known for a K that may be indefinite; derivatives treat it
            as constant.
        row_sums: (n_dof,) the row sums of M over all nodes, from which `read` computes nodal values; infinite in the
            separate equations of `hks_jax.fem.box.in_box`. None if the unknowns are nodal values already.
        weighted_volume: the integral of 1 with the mass, if a density or Fick's operator has another volume element
            than the metric; None otherwise.
        density: (*node_shape) the density √|D| of Fick's volume element dx with respect to that of the metric D⁻¹; None
            for other operators.
    """

    metric: SampledMetric | None
    volume: Float[Array, ""] | None
    space: FunctionSpace = eqx.field(static=True)
    lower_bound: Float[Array, ""] | None = eqx.field(default=None, kw_only=True)
    row_sums: Float[Array, " n_dof"] | None = eqx.field(default=None, kw_only=True)
    weighted_volume: Float[Array, ""] | None = eqx.field(default=None, kw_only=True)
    density: Float[Array, "*node_shape"] | None = eqx.field(default=None, kw_only=True)

    def __repr__(self) -> str:
        return f"Pencil({self.space!r})"

    @property
    def bounded(self) -> bool:
        """Whether a lower bound of the spectrum is known."""
        return self.null_space is not None or self.lower_bound is not None

    @property
    def has_potential(self) -> bool:
        """Whether the operator of a field or a mesh has a potential, or a stiffness of the user's own."""
        return self.metric is not None and self.null_space is None

    @property
    def measured(self) -> bool:
        """Whether dimension and volume are known, which Weyl's law requires."""
        return self.volume is not None and self.space.dimension is not None

    @property
    def measure(self) -> Float[Array, ""] | None:
        """The integral of 1 with the mass, including eliminated nodes; None if it is not known."""
        return self.volume if self.weighted_volume is None else self.weighted_volume

    @property
    def resolution(self) -> Resolution | None:
        """The effect of the node spacing on signatures, for error estimates; None if it is not known."""
        if self.metric is None or self.space.degree == 2:  # no error estimate is known for P2 elements
            return None
        return resolution_of(
            self.metric, self.space, isinstance(self.mass, DiagonalOperator), self.row_sums is not None
        )

    def read(self, functions: Float[Array, "... n_dof"]) -> Float[Array, "... n_dof"]:
        """Return the values of functions at the free nodes, given their unknowns (see `assemble`)."""
        return functions if self.row_sums is None else _read(self.mass, self.row_sums, functions)

    def integrals(self, values: Float[Array, "... n_dof"]) -> Float[Array, "... n_dof"]:
        """Return weights w for nodal ``values`` of a function u: w·φ = ∫φu for all nodal values φ from `read`."""
        if self.row_sums is None:
            return self.mass.apply(values)
        return jnp.broadcast_to(jnp.where(jnp.isinf(self.row_sums), 0, self.row_sums), values.shape) * values

    def with_stiffness(self, stiffness: PatternedOperator) -> "Pencil":
        """Return the pencil with another stiffness, such as K + V, on the same domain; the null space is then unknown.

        ``pencil.with_stiffness(pencil.stiffness.plus(V))`` with V (n_dof,) adds a diagonal matrix.

        Raises:
            ValueError: a matrix with another sparsity pattern.
        """
        if stiffness.pattern != self.pattern:
            raise ValueError(
                "stiffness: got a matrix whose sparsity pattern is not that of the pencil; use `sparse_pencil` for "
                "matrices of other patterns"
            )
        return replace(self, stiffness=stiffness, source=None, null_space=None, lower_bound=None)

    def counted_from(self, origin: Float[Array, ""]) -> "Pencil":
        """Return the pencil of K − σM and M with an empty null space, where σ = ``origin`` is below the spectrum."""
        moved, source = self.moved_by(origin)
        nothing = NullSpace(jnp.zeros((0, self.size), origin.dtype))
        return replace(self, stiffness=moved, source=source, null_space=nothing, lower_bound=None, row_sums=None)

    @property
    def parts(self) -> tuple["Pencil", ...]:
        """The pencil itself, as the only part."""
        return (self,)

    @property
    def including(self) -> Inclusions:
        """The pencil itself is the only part that contains its functions; see `MirrorPencil`."""
        return ((0,),)


@jax.jit
def _read(mass: Operator, row_sums: Float[Array, " n_dof"], functions: Float[Array, "... n_dof"]) -> Array:
    columns = functions.reshape(-1, mass.size).T
    return ((columns + mass.of_columns()(columns) / row_sums[:, None]) / 2).T.reshape(functions.shape)


class MirrorPencil(eqx.Module):
    """The 2^m mixed Neumann/Dirichlet pencils of a domain doubled m times, by reflections or by gluing along the rim.

    The union of the spectra of the 2^m pencils is the spectrum of the doubled domain. An eigenfunction of one of the
    pencils, divided by √2^m, is the restriction of an eigenfunction of the doubled domain to the original domain.

    Attributes:
        parts: the 2^m pencils; the first one has Neumann conditions on all mirrors and glued rims.
    """

    parts: tuple[Pencil, ...]

    @property
    def including(self) -> Inclusions:
        """For each part, itself and the earlier parts whose function spaces contain its function space.

        By the min–max principle, eigenvalue i of a part is not less than eigenvalue i of a part with a larger function
        space. A part whose functions belong to c parts has at most the fraction 1/c of the lowest eigenvalues of the
        doubled domain.
        """
        return _inclusions(tuple(part.space for part in self.parts))

    @property
    def measured(self) -> bool:
        """Whether dimension and volume are known."""
        return self.parts[0].measured

    @property
    def space(self) -> FunctionSpace:
        """The space of the first part, which contains the functions of all parts."""
        return self.parts[0].space

    @property
    def resolution(self) -> Resolution | None:
        """The effect of the node spacing on signatures, for error estimates; None if it is not known."""
        return self.parts[0].resolution

    @property
    def volume(self) -> Float[Array, ""] | None:
        """The area or volume of the doubled domain in the units of the metric."""
        return None if self.parts[0].volume is None else len(self.parts) * self.parts[0].volume

    @property
    def measure(self) -> Float[Array, ""] | None:
        """The integral of 1 over the doubled domain with the mass."""
        return None if self.parts[0].measure is None else len(self.parts) * self.parts[0].measure

    @property
    def density(self) -> Float[Array, "*node_shape"] | None:
        """The density of Fick's volume element with respect to that of the metric; None for other operators."""
        return self.parts[0].density


@lru_cache(maxsize=16)
def _inclusions(spaces: tuple[FunctionSpace, ...]) -> Inclusions:
    free = [space.free for space in spaces]
    return tuple(tuple(j for j in range(i + 1) if not (mask & ~free[j]).any()) for i, mask in enumerate(free))


AnyPencil: TypeAlias = Pencil | MirrorPencil


def from_lower_bound(pencil: AnyPencil) -> tuple[AnyPencil, Float[Array, ""]]:
    """Return the pencil shifted by its lower bound, and this bound; without a bound, the pencil itself and 0."""
    bounds = [part.lower_bound for part in pencil.parts if part.lower_bound is not None]
    if not bounds:
        return pencil, jnp.zeros((), pencil.parts[0].stiffness.dtype)
    origin = jnp.min(jnp.stack(bounds))
    parts = tuple(part.counted_from(origin) for part in pencil.parts)
    return (MirrorPencil(parts) if isinstance(pencil, MirrorPencil) else parts[0]), origin


def assembled(
    stiffness: PatternedOperator,
    consistent: PatternedOperator,
    lumped: Float[Array, "*node_shape"],
    metric: SampledMetric | None,
    volume: Float[Array, ""],
    density: Float[Array, "*node_shape"] | None,
    space: FunctionSpace,
    operator: WeakForm,
    fields: dict[str, Field],
) -> Pencil:
    """Return the pencil of K and M and its known properties; ``lumped`` has the row sums of M at all nodes."""
    mass = DiagonalOperator(entries=space.restrict(lumped)) if operator.lumped else consistent
    if operator.custom:
        return Pencil(stiffness, mass, None, None, space)
    nulls = bound = None
    if "potential" in fields:
        bound = _least(fields["potential"], space, operator)
    else:
        nulls = _constants(space, lumped)
    sums = space.restrict(lumped) if operator.cancelling else None
    weighted = jnp.sum(lumped) if operator.fick or "density" in fields else None
    properties: dict[str, Any] = {"null_space": nulls, "lower_bound": bound, "row_sums": sums, "density": density}
    return Pencil(stiffness, mass, metric, volume, space, **properties, weighted_volume=weighted)


# With a potential V and a density ρ, the stiffness is K = A + ∫ρV hᵢhⱼ, where A ⪰ 0. If the potential is at least v at
# the quadrature points, K − vM ⪰ 0 for the mass M from the same quadrature points. The lumped mass D ⪰ M exceeds the
# consistent mass M, so that K − vD ⪰ 0 is certain only if the least potential v is not positive.
def _least(potential: Field, space: FunctionSpace, operator: WeakForm) -> Float[Array, ""] | None:
    """Return a lower bound of the spectrum, or None if the interpolated potential may fall below its nodal values."""
    if potential.at == "nodes" and isinstance(space, MeshSpace) and space.degree == 2:
        return None
    least = jnp.min(jax.lax.stop_gradient(potential.values))
    return jnp.minimum(least, 0) if operator.lumped else least


def _constants(space: FunctionSpace, values: Array) -> NullSpace:
    """Return the null space of a Laplace–Beltrami operator: the constants on components without Dirichlet nodes."""
    n_null, labels, numbers = space.n_null, space.null_labels, jnp if is_staged() else np
    if n_null == 0 or (n_null == 1 and (labels == 0).all()):
        vectors = numbers.ones((n_null, space.n_dof), values.dtype)
    else:
        number = numbers.arange(n_null, dtype=np.int32)[:, None]
        vectors = (numbers.asarray(labels, np.int32)[None] == number).astype(values.dtype)
    return NullSpace(jax_array(vectors), fixed=True)


def gathered(space: MeshSpace | VectorSpace, matrices: Float[Array, "E m m"]) -> SparseOperator:
    """Assemble the matrices of all elements into a sparse matrix."""
    where, slots, pattern = _sparse_pattern(space)
    return SparseOperator(jax.ops.segment_sum(matrices.reshape(-1)[where], slots, pattern.rows.size), pattern)


def row_sums_of(space: MeshSpace | VectorSpace, matrices: Float[Array, "E m m"]) -> Float[Array, "*node_shape"]:
    """Return the row sums of the assembled matrix at all nodes, including the columns of eliminated nodes."""
    sums = jnp.sum(matrices, axis=-1).ravel()
    return jax.ops.segment_sum(sums, space.cells.ravel(), space.free.size).reshape(space.node_shape)


@lru_cache(maxsize=16)
def _sparse_pattern(space: MeshSpace | VectorSpace) -> tuple[np.ndarray, np.ndarray, SparsePattern]:
    n, corners = space.n_dof, space.cells.shape[1]
    cells = space.degrees_of_freedom[space.cells]
    rows, cols = np.repeat(cells, corners, axis=1).ravel(), np.tile(cells, (1, corners)).ravel()
    where = np.flatnonzero((rows >= 0) & (cols >= 0))
    keys, slots = np.unique(rows[where] * n + cols[where], return_inverse=True)
    return where, slots, SparsePattern(n, keys // n, keys % n)
