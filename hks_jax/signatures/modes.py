"""Maps in the modes of a domain: coefficients, reconstructions, energies and filters.

Eigenfunctions are orthonormal in the inner product ∫uv = uᵀMv, and not in the plain dot product uᵀv of
nodal values. All functions of this module use the mass M.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hks_jax.accuracy import warn_of_accuracy
from hks_jax.arrays import ByKey, nan_is_meant
from hks_jax.checks import real_array, require_number, require_real
from hks_jax.compilation import library_of, numpy_where_known
from hks_jax.eigen.eigenpairs import Eigenpairs, require_pairs
from hks_jax.fem.resolution import mean_diffusivity
from hks_jax.linear import lapack
from hks_jax.linear.operators import Operator
from hks_jax.linear.products import inner_products, matmul
from hks_jax.signatures.filters import Custom
from hks_jax.signatures.spectral_functions import spectral_flow
from hks_jax.traced import is_traced

_UNSURE = 0.01
"""The least eigenvalue of the modes' Gram matrix over the measured nodes below which coefficients are warned of."""


class ModeEnergies(eqx.Module):
    """The energies of maps in modes, over the domain itself (`energy`).

    Attributes:
        coefficients: (…, k) the coefficients cᵢ = ∫φᵢf of `decompose`.
        eigenvalues: (k,).
        wavelength: (k,) the wavelength 2π√(D/λ) of a plane wave with the eigenvalue λ, for the mean diffusivity D, in
            the units of the domain (mm for voxels or vertices in mm); infinite for λ = 0.
        fwhm: (k,) the full width at half maximum of the Gaussian that halves this wave, 4 ln2 √(D/λ).
        energy: (…, k) ∫(cᵢφᵢ)² over the domain, which is cᵢ², except on a doubled domain. Within a multiple eigenvalue
            only the sum has a meaning.
        residual: (…, k) ∫(f − c₁φ₁ − … − cᵢφᵢ)² of the first i modes; over the measured nodes, if some are not.
        explained: (…, k) the share of variance that the first i modes explain, 1 − residual/∫(f − f̄)², where f̄ is the
            mean of f. It may be negative for few modes that lack the constants. NaN for constant f.
        total: (…) ∫f².
    """

    coefficients: Float[Array, "*functions k"]
    eigenvalues: Float[Array, " k"]
    wavelength: Float[Array, " k"]
    fwhm: Float[Array, " k"]
    energy: Float[Array, "*functions k"]
    residual: Float[Array, "*functions k"]
    explained: Float[Array, "*functions k"]
    total: Float[Array, "*functions"]


@nan_is_meant
def decompose(pairs: Eigenpairs, f: Any) -> Float[Array, "*functions k"]:
    """Return the coefficients cᵢ = ∫φᵢf of maps in the modes, ΦᵀMf with the mass M.

    The sum Σᵢ cᵢφᵢ (`reconstruct`) is the projection of f onto the modes in the norm ∫u². The plain dot product Φᵀf of
    nodal values is not: eigenvectors are not orthogonal in it, because nodes have unequal areas or volumes.

    Nodes may be unmeasured, which NaN in f tells; they must be the same in all maps. The coefficients are then those of
    the least-squares fit Σᵢ cᵢφᵢ to the measured nodes S, in the norm uᵀMu of the residual, which is set to 0 at the
    other nodes. A map that is a sum of the modes is recovered exactly, if S determines the coefficients.

    Coefficients are differentiable with respect to f and the tensors. At a multiple eigenvalue, whose modes have an
    arbitrary basis, their derivative with respect to the tensors is NaN, but that of `spectral_filter` exists. Under
    `jit`, where f is not known, coefficients are NaN if maps have NaN at other nodes than the first map has.

    Args:
        pairs: the result of `eigenpairs`. Under ``"mirror"`` and ``"mean"``, f is reflected to the doubled domain with
            m parts, over which ∫ is taken: coefficients are 0 for odd modes, and Σᵢ cᵢ² tends to m ∫f² over the domain
            itself. Coefficients of pairs that are not ``kept`` are 0. With ``quadrature="cancelling"``, nodal values
            of modes are orthonormal only up to fourth order in the spacing; coefficients are those of the projection.
        f: (*shape), or (…, *shape) for several maps, such as a time series. Values outside the mask and at Dirichlet
            nodes are not used.

    Raises:
        ValueError: if f has another shape or is infinite, if maps have NaN at different nodes, or if the measured nodes
            do not determine the coefficients (under `jit`, coefficients are NaN).

    Warns:
        AccuracyWarning: if the fit to the measured nodes amplifies errors of f by a factor of 10 or more.

    Examples:
        >>> f = field.grid.nodes[..., 0]
        >>> c = hj.decompose(pairs, f)
        >>> print((c[:1] / jnp.sqrt(2)).round(3))  # the mean of f, because ∫1 = 2
        [0.5]
    """
    fit = _fitted(pairs, f)
    return _of_doubled(pairs, fit.coefficients).reshape(*fit.leading, pairs.k)


@nan_is_meant
def reconstruct(pairs: Eigenpairs, c: Any) -> Float[Array, "*functions_and_shape"]:
    """Return the maps Σᵢ cᵢφᵢ(x) of coefficients; NaN outside the mask, and 0 at Dirichlet nodes.

    Args:
        pairs: the result of `eigenpairs`; pairs that are not ``kept`` are not used.
        c: (m,) coefficients of the first m ≤ k modes, or (…, m) for several maps.

    Raises:
        ValueError: if there are more coefficients than modes.

    Examples:
        >>> f = hj.reconstruct(pairs, jnp.ones(12))
        >>> print(jnp.abs(hj.decompose(pairs, f) - 1).max() < 1e-4)
        True
    """
    dtype = require_pairs(pairs).eigenvalues.dtype
    coefficients = real_array("c", c).astype(dtype)
    m = coefficients.shape[-1] if coefficients.ndim else 0
    if not 1 <= m <= pairs.k:
        raise ValueError(f"c: got shape {coefficients.shape}; expected (…, m) with 1 to {pairs.k} coefficients")
    nodal = _sum(coefficients.reshape(-1, m), pairs.kept, pairs.at_nodes)
    return pairs.space.extend(nodal).reshape(*coefficients.shape[:-1], *pairs.space.node_shape)


@numpy_where_known()
def _sum(coefficients: Any, kept: Any, modes: Any) -> Any:
    xp = library_of(coefficients)
    m = coefficients.shape[1]
    return matmul(xp.where(kept[None, :m], coefficients, 0), modes[:m])


@nan_is_meant
def energy(pairs: Eigenpairs, f: Any, diffusivity: Any = None) -> ModeEnergies:
    """Return the coefficients of maps and their energies ∫(cᵢφᵢ)², the modes' wavelengths, and the variance explained.

    The energies and the last residual add up to ∫f² (Parseval), if all nodes are measured; with the quadrature
    ``"cancelling"`` up to errors of fourth order.

    Args:
        pairs: the result of `eigenpairs`.
        f: (*shape) or (…, *shape), as in `decompose`.
        diffusivity: the D of wavelengths, for which a plane wave cos(ξ·x) has the eigenvalue D|ξ|². None means the mean
            of trace(T⁻¹)/d over the domain with the metric T, which for the metric D⁻¹ and for Fick's operator is the
            mean diffusivity, and is 1 for a mesh without tensors.

    Raises:
        ValueError: as in `decompose`, or if the diffusivity is not positive.

    Warns:
        AccuracyWarning: as in `decompose`.

    Examples:
        >>> found = hj.energy(pairs, jnp.cos(jnp.pi * field.grid.nodes[..., 0]))  # a wavelength of 2
        >>> print(found.energy.argmax(), found.explained[-1] > 0.9)
        1 True
        >>> print(jnp.isclose(found.energy.sum() + found.residual[-1], found.total))
        True
    """
    fit = _fitted(pairs, f)
    c, k, dtype = fit.coefficients, pairs.k, fit.coefficients.dtype
    known = np.ones(fit.rows.shape[1:], dtype) if fit.measured is None else fit.measured.astype(dtype)
    gram = np.eye(c.shape[1], dtype=dtype) if fit.gram is None else fit.gram
    terms = pairs.of_even(_terms(c, gram))
    residual, share, total = _residuals(_measure(pairs), fit.rows, known, c, fit.modes, terms)
    return ModeEnergies(
        _of_doubled(pairs, c).reshape(*fit.leading, k),
        pairs.eigenvalues,
        *lengths_of(pairs, diffusivity),
        pairs.of_even(c * c).reshape(*fit.leading, k),
        residual.reshape(*fit.leading, k),
        share.reshape(*fit.leading, k),
        total.reshape(fit.leading),
    )


# The residual f − Σcⱼφⱼ of the fit is orthogonal to all modes. So the residual of the first i modes is the sum of the
# squared norms of the fit's residual and of Σ_{j>i} cⱼφⱼ, which is a sum over j > i of the ``terms``.
@numpy_where_known()
def _terms(c: Any, gram: Any) -> Any:
    xp = library_of(c)
    return c * (2 * matmul(c, xp.tril(gram, -1)) + xp.diagonal(gram)[None] * c)


@numpy_where_known()
def _residuals(measure: Any, rows: Any, known: Any, c: Any, modes: Any, terms: Any) -> tuple[Any, Any, Any]:
    """Return the residuals and the shares of variance (s, k), and ∫f² (s)."""
    xp = library_of(c)

    def integral(u: Any) -> Any:
        return xp.sum(u * _weighted(measure, u), axis=1)

    total, one = integral(rows), known[None]
    mean = xp.sum(_weighted(measure, rows) * one, axis=1) / integral(one)
    variance = integral(rows - mean[:, None] * one)
    beyond = xp.cumsum(terms[:, ::-1], axis=1)[:, ::-1] - terms
    left = integral((rows - matmul(c, modes)) * one)
    residual = xp.maximum(left[:, None] + beyond, 0)
    varies = variance > xp.finfo(c.dtype).eps * total
    share = xp.where(varies[:, None], 1 - residual / xp.where(varies, variance, 1)[:, None], xp.nan)
    return residual, share, total


def lengths_of(pairs: Eigenpairs, diffusivity: Any = None) -> tuple[Float[Array, " k"], Float[Array, " k"]]:
    """Return the wavelengths and the widths (FWHM) for which modes stand, as `energy` documents them."""
    dtype = pairs.eigenvalues.dtype
    if diffusivity is None:
        diffusivity = mean_diffusivity(pairs.problems[0].pencil.metric, pairs.space, dtype)
    else:
        require_number("diffusivity", diffusivity)
    return _lengths(pairs.eigenvalues, jnp.asarray(diffusivity, dtype))


# A Gaussian of standard deviation σ multiplies a wave cos(ξ·x) by exp(−σ²|ξ|²/2), which is ½ for σ = √(2 ln2)/|ξ|. Its
# full width at half maximum is 2√(2 ln2) σ = 4 ln2/|ξ|.
@numpy_where_known()
def _lengths(values: Any, diffusivity: Any) -> tuple[Any, Any]:
    """Return the wavelength 2π/|ξ| and the width 4 ln2/|ξ| for |ξ|² = λ/D; infinite where λ ≤ 0."""
    xp = library_of(values)
    positive = values > 0
    lengths = xp.where(positive, xp.sqrt(diffusivity / xp.where(positive, values, 1)), xp.inf)
    return 2 * math.pi * lengths, 4 * math.log(2.0) * lengths


class _OfEigenvalue(ByKey):
    """A function g(λ) as a function (θ, λ), equal for equal g, so that it is compiled once."""

    def __init__(self, function: Callable[[Array], Array]) -> None:
        self._key = function

    def __call__(self, _: Any, x: Array) -> Array:
        return self._key(x)


@nan_is_meant
def spectral_filter(
    pairs: Eigenpairs, f: Any, function: Callable[..., Array], parameters: Any = None
) -> Float[Array, "*functions_and_shape"]:
    """Return the filtered maps Σᵢ g(λᵢ) φᵢ ∫φᵢf for any function g of the eigenvalue.

    The filter exp(−λt) gives `heat_flow`, and the indicator of an interval of λ a band of wavelengths. Derivatives with
    respect to f, the tensors and θ are exact at eigenvalues of any multiplicity. The filter acts within the k modes: f
    beyond them does not enter, also where g is large. If nodes are unmeasured (NaN), the fit of `decompose` is filtered
    in place of f; its derivative with respect to the tensors is then NaN at multiple eigenvalues. The result is NaN
    outside the mask, and 0 at Dirichlet nodes.

    Args:
        pairs: the result of `eigenpairs`.
        f: (*shape) or (…, *shape), as in `decompose`.
        function: maps λ of any shape to g elementwise, or with parameters (θ, λ), as in `spectral_signature`. Define it
            once, because every new function object is compiled again.
        parameters: θ, a pytree of floating point arrays with a leading axis m. Pass traced values here, not by closure.

    Returns:
        (*shape) or (…, *shape), and with parameters (m, *shape) or (m, …, *shape).

    Raises:
        ValueError: as in `decompose`, or if the parameters have no common leading axis.

    Warns:
        AccuracyWarning: as in `decompose`.

    Examples:
        >>> f = field.grid.nodes[..., 0]
        >>> smooth = hj.spectral_filter(pairs, f, lambda x: jnp.exp(-0.5 * x))
        >>> print(jnp.allclose(smooth, hj.heat_flow(pairs, [0.5], f)[0], atol=1e-4))
        True
    """
    dtype = require_pairs(pairs).eigenvalues.dtype
    if parameters is None:
        filters = Custom(_OfEigenvalue(function), jnp.zeros(1, dtype))
    else:
        require_real("parameters", parameters)
        parameters = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), parameters)
        shapes = [leaf.shape for leaf in jax.tree.leaves(parameters)]
        if not shapes or not all(shapes) or len({shape[0] for shape in shapes}) != 1:
            raise ValueError(f"parameters: got arrays of shapes {shapes}; expected equal first axes, one per filter")
        filters = Custom(function, parameters)
    rows, leading, measured = _given(pairs, f)
    if measured is not None:
        fit = _fitted(pairs, f)
        rows = jnp.where(jnp.all(measured), rows, matmul(fit.coefficients, fit.modes))
    shape = pairs.space.node_shape
    flow = spectral_flow(pairs, filters, pairs.space.extend(rows, outside=0.0))
    return flow.reshape(*(() if parameters is None else flow.shape[:1]), *leading, *shape)


class _Fit(NamedTuple):
    """The least-squares fit of the modes of the even problem to maps at the free nodes."""

    rows: Float[Array, "s n"]  # the maps, 0 at unmeasured nodes
    leading: tuple[int, ...]  # the axes of the maps
    measured: Bool[Array, " n"] | None  # None if all nodes are known to be measured
    modes: Float[Array, "k n"]  # the modes at the nodes; 0 for those not kept
    coefficients: Float[Array, "s k"]
    gram: Float[Array, "k k"] | None  # the inner products of the modes over the measured nodes; None for the identity


def _given(
    pairs: Eigenpairs, f: Any
) -> tuple[Float[Array, "s n"], tuple[int, ...], Bool[np.ndarray | Array, " n"] | None]:
    """Return maps at the free nodes, 0 where unmeasured, their leading axes, and the mask of measured nodes."""
    space, shape = require_pairs(pairs).space, pairs.space.node_shape
    u = real_array("f", f).astype(pairs.eigenvalues.dtype)
    if u.shape[u.ndim - len(shape) :] != shape or u.ndim < len(shape):
        raise ValueError(
            f"f: got shape {u.shape}; expected {shape}, one value per node, with optional leading axes for several maps"
        )
    leading = u.shape[: u.ndim - len(shape)]
    rows = space.restrict(u.reshape(-1, *shape))
    if is_traced(rows):
        unmeasured = jnp.isnan(rows)
        other = jnp.any(unmeasured != unmeasured[:1], axis=1, keepdims=True)  # refused if values are concrete
        return jnp.where(other, jnp.nan, jnp.where(unmeasured[:1], 0, rows)), leading, ~unmeasured[0]
    known = np.asarray(rows)
    if infinite := int(np.isinf(known).sum()):
        raise ValueError(f"f: got {infinite} infinite values inside the mask; expected finite values, or NaN")
    missing = np.isnan(known)
    if not missing.any():
        return rows, leading, None
    if (missing != missing[0]).any():
        some = int((missing.any(axis=0) & ~missing.all(axis=0)).sum())
        raise ValueError(
            f"f: got {some} nodes with NaN in only some of {len(known)} maps; expected NaN in all maps or in none. "
            "Decompose maps with the same unmeasured nodes together"
        )
    if missing.all():
        raise ValueError("f: got NaN at all nodes inside the mask; expected measured values")
    return jnp.asarray(np.where(missing, 0, known)), leading, ~missing[0]


def _fitted(pairs: Eigenpairs, f: Any) -> _Fit:
    """Return the fit of `decompose`, after its checks of the maps f."""
    rows, leading, measured = _given(pairs, f)
    even, measure = pairs.problems[0], _measure(pairs)
    modes = _chosen(even.at_nodes, even.kept)
    if measured is None and measure[1] is None:
        return _Fit(rows, leading, None, modes, _products(measure, modes, rows, None), None)
    gram = partial(_gram, measure, kept=even.kept)
    if measured is not None and is_traced(measured) and measure[1] is None:
        identity = jnp.eye(even.k, dtype=modes.dtype)
        inner = jax.lax.cond(jnp.all(jnp.asarray(measured)), lambda *_: identity, gram, modes, measured)
    else:
        inner = gram(modes, measured)
    coefficients, least = _solved(inner, _products(measure, modes, rows, measured))
    _tell_if_unsure(pairs.k, least, measured)
    mask = None if measured is None else jnp.asarray(measured)
    return _Fit(rows, leading, mask, modes, coefficients, inner)


def _measure(pairs: Eigenpairs) -> tuple[Operator, Float[Array, " n"] | None]:
    """Return the mass of the domain, and for cancelling elements its row sums, which integrate nodal values."""
    pencil = pairs.problems[0].pencil
    return pencil.mass, pencil.row_sums


# On a domain doubled m times, an even mode has norm 1; on the domain itself, it is 1/√2ᵐ times the mode of the even
# problem, and its integral with a map over the doubled domain is 2ᵐ times that over the domain itself.
def _of_doubled(pairs: Eigenpairs, coefficients: Float[Array, "s k0"]) -> Float[Array, "s k"]:
    """Return the coefficients in all modes, given those in the modes of the even problem."""
    return pairs.of_even(coefficients if len(pairs.problems) == 1 else math.sqrt(len(pairs.problems)) * coefficients)


def _weighted(measure: Any, rows: Any) -> Any:
    """Return weights w (s, n) for nodal values of functions u: w·φ = ∫φu, as `Pencil.integrals` does."""
    xp = library_of(rows)
    mass, row_sums = measure
    return (mass @ rows.T).T if row_sums is None else xp.where(xp.isinf(row_sums), 0, row_sums)[None] * rows


@numpy_where_known()
def _chosen(modes: Any, kept: Any) -> Any:
    return library_of(modes).where(kept[:, None], modes, 0)


@numpy_where_known()
def _products(measure: Any, modes: Any, rows: Any, measured: Any) -> Any:
    """Return the inner products (s, k) of rows, which are 0 at unmeasured nodes, with the modes at measured nodes."""
    xp = library_of(rows)
    own = modes if measured is None else xp.where(measured[None], modes, 0)
    if len(own) < len(rows):  # the mass is symmetric: it multiplies the smaller factor
        own = _weighted(measure, own)
    else:
        rows = _weighted(measure, rows)
    return inner_products(own, rows) if xp is jnp else rows @ own.T


def _gram(measure: Any, modes: Any, measured: Any, kept: Any) -> Float[Array, "k k"]:
    """Return the inner products of the modes over the measured nodes, and 1 on the diagonal for unused modes."""
    own = modes if measured is None else jnp.where(measured[None], modes, 0)
    return _products(measure, own, own, measured) + jnp.diag(1 - kept.astype(modes.dtype))


@numpy_where_known()
def _solved(gram: Any, products: Any) -> tuple[Any, Any]:
    """Return the coefficients, NaN if they are not determined, and the least eigenvalue of the Gram matrix."""
    xp = library_of(gram)
    values, vectors = np.linalg.eigh(gram) if xp is np else lapack.eigh(jax.lax.stop_gradient(gram))
    determined = values[0] > _negligible(gram.dtype)
    divisors = xp.where(determined, values, 1)[:, None]

    def inverse(columns: Any) -> Any:
        return matmul(vectors, matmul(vectors.T, columns) / divisors)

    if xp is np:
        columns = inverse(products.T)
    else:
        image, solve = partial(matmul, gram), lambda _, columns: inverse(columns)
        columns = jax.lax.custom_linear_solve(image, products.T, solve, symmetric=True)
    return xp.where(determined, columns.T, xp.nan), values[0]


def _negligible(dtype: Any) -> float:
    return float(jnp.finfo(dtype).eps) ** 0.5


def _tell_if_unsure(k: int, least: Float[Array, ""], measured: Any) -> None:
    """Raise ValueError or warn if the measured nodes determine the coefficients badly; do nothing for traced values."""
    if is_traced((least, measured)) or measured is None:
        return
    lowest, known = float(least), f"{int(np.sum(measured))} of {len(measured)} nodes measured"
    if lowest <= _negligible(np.asarray(least).dtype):
        raise ValueError(
            f"f: got {known}, which do not determine the coefficients of {k} modes. Use fewer modes, or measure more "
            "nodes"
        )
    if lowest < _UNSURE:
        warn_of_accuracy(
            f"f: with {known}, the fit of {k} modes amplifies errors of f by up to {lowest**-0.5:.3g} in the "
            "coefficients. Use fewer modes"
        )
