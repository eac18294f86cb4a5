"""From the matrices of elements to those of a pencil, and its null space."""

from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.fem.fields import Field
from hks_jax.fem.forms import WeakForm
from hks_jax.fem.pencil import Pencil
from hks_jax.fem.resolution import SampledMetric
from hks_jax.fem.space import FunctionSpace, MeshSpace, VectorSpace
from hks_jax.linear.operators import DiagonalOperator, PatternedOperator, SparseOperator
from hks_jax.linear.pattern import SparsePattern
from hks_jax.linear.pencil import NullSpace
from hks_jax.traced import is_staged


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
    """Return the pencil of two matrices, with what is known of it.

    Args:
        stiffness: K.
        consistent: M, unless it is to be lumped.
        lumped: the row sums of M at all nodes.
        metric: for estimates; None where there are none.
        volume: of the domain.
        space: of its functions.
        operator: what was assembled.
        fields: what it reads.
    """
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
