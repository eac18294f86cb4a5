"""Spectral functions Φ f(Λ) Φᵀ, which all signatures use, and their derivative rule."""

import operator
from collections.abc import Callable
from functools import partial, reduce

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from hks_jax.arrays import StaticArray, nan_outside
from hks_jax.checks import require_static
from hks_jax.compilation import jit_quickly
from hks_jax.eigen.eigenpairs import Eigenpairs, PencilEigenpairs
from hks_jax.eigen.rotations import changes_between
from hks_jax.fem.pencil import Pencil
from hks_jax.fem.space import FunctionSpace
from hks_jax.linear.linear_map import first_order_only, instantiated, is_constant
from hks_jax.linear.linear_program import linear_program
from hks_jax.linear.products import row_blocks
from hks_jax.signatures.contractions import Applied, Columns, Contraction, Diagonal, SquaredDistances, host_map
from hks_jax.signatures.filters import Custom, Derivative, Filter, mixing, weights_of

_FILTERS = 8
"""The number of filters whose matrices (k, k) are computed and applied to the eigenvectors at once."""


def spectral_diagonal(
    pairs: Eigenpairs, filters: Filter, scale: Float[Array, " m"] | None = None
) -> Float[Array, "m *shape"]:
    """Return Σᵢ f(λᵢ) φᵢ(x)² for each of m filters f, times the filter's entry of ``scale``; NaN outside the mask."""
    diagonal = _mean(pairs, filters, lambda space: Diagonal())
    # NaN is inserted after the multiplication, because 0·NaN would make the derivative with respect to ``scale`` NaN.
    scaled = diagonal if scale is None else scale.reshape(-1, *[1] * len(pairs.space.node_shape)) * diagonal
    return nan_outside(scaled, pairs.space.domain)


def spectral_columns(pairs: Eigenpairs, filters: Filter, sources: Int[np.ndarray, " s"]) -> Float[Array, "m s *shape"]:
    """Return Σᵢ f(λᵢ) φᵢ(x_s) φᵢ(x) for each filter and each source node (flat node index); NaN outside the mask."""
    columns = _mean(pairs, filters, lambda space: Columns(space, StaticArray(sources)))
    return nan_outside(columns, pairs.space.domain)


def spectral_squared_distances(
    pairs: Eigenpairs, filters: Filter, sources: Int[np.ndarray, " s"]
) -> Float[Array, "m s *shape"]:
    """Return Σᵢ f(λᵢ) (φᵢ(x_s) − φᵢ(x))² for each filter and each source node; meaningless outside the mask."""
    return _mean(pairs, filters, lambda space: SquaredDistances(space, StaticArray(sources)))


def spectral_flow(
    pairs: Eigenpairs, filters: Filter, functions: Float[Array, "s *shape"]
) -> Float[Array, "m s *shape"]:
    """Return Σᵢ f(λᵢ) φᵢ(x) ∫φᵢu for each of m filters and s functions u; NaN outside the mask.

    Under "mirror" and "mean" functions are reflected to the doubled domain, as the metric is. So they are even, and
    only the even problem matters.
    """
    even = pairs.problems[0]
    flow = _kernel(Applied(even.pencil.integrals(even.space.restrict(functions))), filters, even)
    return even.space.extend(flow)


def spectral_trace(pairs: Eigenpairs, filters: Filter) -> Float[Array, " m"]:
    """Return Σᵢ f(λᵢ) for each of m filters. The derivative f'(λᵢ) dλᵢ needs no eigenvector."""
    return jnp.sum(_all_weights(filters, pairs.eigenvalues, pairs.kept), axis=1)


# Functions on a doubled domain are sums of functions of its even and odd problems. A point source is the mean of an
# even function and odd ones, so the kernel between points of the original domain is the mean of the problems' kernels.
def _mean(pairs: Eigenpairs, filters: Filter, contraction: Callable[[FunctionSpace], Contraction]) -> Array:
    """Return the mean over all problems of the contractions (…, *shape) of kernels; meaningless outside the mask."""
    nodal = [_nodal(each.space, _kernel(contraction(each.space), filters, each)) for each in pairs.problems]
    return nodal[0] if len(nodal) == 1 else reduce(operator.add, nodal) / len(nodal)


def _nodal(space: FunctionSpace, values: Float[Array, "*leading n"]) -> Float[Array, "*leading_and_shape"]:
    """Return the nodal values of a contraction, which are given at the free nodes or at all nodes."""
    if values.shape[-1] == space.n_dof:
        return space.extend(values, outside=0.0)
    return values.reshape(*values.shape[:-1], *space.node_shape)


@jax.custom_jvp
def _kernel(contraction: Contraction, filters: Filter, pairs: PencilEigenpairs) -> Array:
    """Return the contraction of the kernels Φ f(Λ) Φᵀ of m filters."""
    # Second derivatives, for which JAX would differentiate this function and not its rule, are not supported.
    pairs = first_order_only(pairs)
    return _weighted(contraction, _all_weights(filters, pairs.eigenvalues, pairs.kept), pairs.pencil.read(pairs.frame))


@jit_quickly()
def _weighted(contraction: Contraction, weights: Float[Array, "m k"], vectors: Float[Array, "k n"]) -> Array:
    return contraction.weighted(weights, vectors)


# The kernel f(M⁻¹K)M⁻¹ is a smooth function of the matrices K and M even where the eigenvectors are not smooth. Let Φ
# have all n eigenvectors, and let G = Φᵀ dK Φ and H = Φᵀ dM Φ. By the divided differences of f (Daleckii and Krein
# 1965), the differential of the kernel is Φ F Φᵀ with the matrix
#
#     F = [f]∘G − [λf]∘H,    [f]ᵢⱼ = (f(λᵢ) − f(λⱼ))/(λᵢ − λⱼ),  [f]ᵢᵢ = f'(λᵢ),    [λf]ᵢⱼ = f(λᵢ) + λⱼ [f]ᵢⱼ.
#
# The matrix F does not depend on the basis chosen for a multiple eigenvalue, and is finite. If only some pairs are
# kept, f is set to zero on all others, and the entries of F between kept pairs do not change. The entries of F between
# a kept pair i and a pair j that is not kept are f(λᵢ) (Gᵢⱼ − λᵢHᵢⱼ)/(λᵢ − λⱼ).
#
# Only k of the n pairs are known, and a signature may keep fewer. `mixing` and `changes_between` give the entries of F
# between the k known pairs. The entries of F between a kept pair i and the unknown pairs add to the differential
#
#     Σᵢ f(λᵢ) (φᵢxᵢᵀ + xᵢφᵢᵀ),    xᵢ = (I − ΦΦᵀM) dφᵢ,
#
# where Φ has the k known eigenvectors, kept or not. So xᵢ is the part of dφᵢ outside the span of all k known
# eigenvectors, and this is the derivative of the frame (hks_jax/eigen/derivative.py).
#
# Signatures use the kernel RΦ f(Λ) ΦᵀRᵀ, where the matrix R maps coefficients to values at the nodes (`Pencil.read`).
# In the differential of this kernel, R multiplies each φᵢ and xᵢ from the left, and the derivative dR adds the terms
# f(λᵢ) ((dR φᵢ)(Rφᵢ)ᵀ + (Rφᵢ)(dR φᵢ)ᵀ).
@partial(_kernel.defjvp, symbolic_zeros=True)
def _kernel_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    (contraction, filters, pairs), (d_contraction, d_filters, d_pairs) = primals, tangents
    value, terms = _kernel(contraction, filters, pairs), []
    if isinstance(contraction, Applied) and not is_constant(d_contraction.functionals):
        terms.append(_kernel(d_contraction, filters, pairs))  # linear in the functionals
    if not is_constant(d_filters):
        terms.append(_kernel(contraction, Derivative(filters, instantiated(d_filters)), pairs))
    if not is_constant(d_pairs.pencil):
        pairs = first_order_only(pairs)
        pencil, moved = pairs.pencil, instantiated((d_pairs.frame, d_pairs.pencil))
        reader = None if pencil.row_sums is None else pencil
        known = contraction, filters, pairs.eigenvalues, pairs.frame, pairs.kept, reader
        terms.append(linear_program(_tangent, (pencil.n_fixed > 0,), known, moved, value, host_map))
    elif not is_constant((d_pairs.eigenvalues, d_pairs.frame)):  # the arrays themselves change, so JAX's rules apply
        pairs = first_order_only(pairs)
        moved = jax.jvp(
            lambda values, vectors: _weighted(
                contraction, _all_weights(filters, values, pairs.kept), pairs.pencil.read(vectors)
            ),
            (pairs.eigenvalues, pairs.frame),
            instantiated((d_pairs.eigenvalues, d_pairs.frame)),
        )
        terms.append(moved[1])
    return value, reduce(operator.add, terms) if terms else jnp.zeros_like(value)


# The transposed derivative recomputes intermediate results, which would take twice the memory of the eigenvectors.
@partial(jax.checkpoint, static_argnums=0)
def _tangent(
    fixed: bool,
    contraction: Contraction,
    filters: Filter,
    values: Float[Array, " k"],
    vectors: Float[Array, "k n_dof"],
    kept: Bool[Array, " k"],
    reader: Pencil | None,
    changes: tuple[Float[Array, "k n_dof"], Pencil],
) -> Array:
    """Return the derivative of the contraction for the change of the pencil, given its pairs.

    ``changes`` are the xᵢ of the pairs (d_frame), and the change of the pencil.
    """
    d_frame, change = changes
    d_frame = jnp.where(kept[:, None], d_frame, 0)  # d_frame may be NaN where pairs are not kept
    stiffness, mass = changes_between(vectors, change)
    weights = _all_weights(filters, values, kept)
    read, d_read = vectors, d_frame
    if reader is not None:
        read, d_read = jax.jvp(Pencil.read, (reader, vectors), (change, d_frame))
    _, outer = jax.jvp(lambda x: contraction.weighted(weights, x), (read,), (d_read,))

    def inner(some: Filter) -> Array:
        _, of_f, of_lambda_f, matters = mixing(some, values, kept, fixed)
        return contraction.mixed(of_f * stiffness[None] - of_lambda_f * mass[None], read, matters)

    together = min(_FILTERS, len(weights))
    starts, place = row_blocks(len(weights), together)
    some = starts[:, None] + np.arange(together)
    return outer + jax.lax.map(inner, jax.tree.map(lambda leaf: leaf[some], filters))[place]


def _all_weights(filters: Filter, values: Float[Array, " k"], kept: Bool[Array, " k"]) -> Float[Array, "m k"]:
    plain = filters
    while isinstance(plain, Derivative):
        plain = plain.filter
    # A user's function may be a new object at every call, which would be compiled each time.
    return (_each if isinstance(plain, Custom) else _each_at_once)(filters, values, kept)


def _each(filters: Filter, values: Float[Array, " k"], kept: Bool[Array, " k"]) -> Float[Array, "m k"]:
    return jax.vmap(lambda one: weights_of(one, values, kept))(filters)


_each_at_once = jit_quickly()(_each)


def source_indices(pairs: Eigenpairs, sources: object) -> Int[np.ndarray, " s"]:
    """Return flat node indices of sources, given as grid indices (s, d) or (d,), or as vertex numbers (s,) or ()."""
    require_static("sources", sources)
    shape = pairs.space.node_shape
    array = np.asarray(sources)
    if not np.issubdtype(array.dtype, np.integer):
        raise ValueError(f"sources: got dtype {array.dtype}; expected integer node indices")
    indices = array.reshape(-1, len(shape)) if array.size % len(shape) == 0 else array
    expected = "(s,) vertex numbers" if len(shape) == 1 else f"(s, {len(shape)}) node indices"
    if indices.shape[-1:] != (len(shape),) or (len(shape) > 1 and array.shape[-1:] != (len(shape),)):
        raise ValueError(f"sources: got shape {array.shape}; expected {expected}")
    if (indices < 0).any() or (indices >= shape).any():
        raise ValueError(f"sources: got indices {indices.min()} … {indices.max()}; expected nodes of shape {shape}")
    flat = np.ravel_multi_index(tuple(indices.T), shape)
    outside = ~pairs.space.domain.ravel()[flat]
    if outside.any():
        raise ValueError(
            f"sources: got {int(outside.sum())} of {flat.size} nodes outside the mask (the first is "
            f"{tuple(indices[outside][0].tolist())}); expected nodes of the domain"
        )
    return flat
