"""Checks of tensors and deformation gradients with their messages, and maps from indefinite tensors to metrics."""

import contextlib
import math
from typing import Any, Literal, NoReturn

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hks_jax.checks import real_array, require_number
from hks_jax.domain import spd
from hks_jax.domain.grid import Grid
from hks_jax.traced import is_traced

MetricChoice = Literal["tensor", "inverse", "adjugate"]
OperatorChoice = Literal["laplace-beltrami", "fick"]
Interpolation = Literal["linear", "log-euclidean"]

MANY = 0.05
"""The largest fraction of the tensors that noise at the rim of a mask plausibly makes invalid."""


def of_diffusion(metric: str | None, operator: str) -> MetricChoice:
    """Return the metric that is made of diffusion tensors D for an operator; Fick's operator has the metric D⁻¹.

    Raises:
        ValueError: an unknown name; no metric for the Laplace–Beltrami operator; a metric for Fick's operator.
    """
    if checked_operator(operator) == "fick":
        if metric is not None:
            raise ValueError(
                f'metric: got {metric!r} with operator="fick", which determines the metric D⁻¹. Leave one of them out'
            )
        return "inverse"
    if metric not in ("tensor", "inverse", "adjugate"):
        raise ValueError(
            f'metric: got {metric!r}; expected "inverse" (g = D⁻¹, in which points are near if diffusion is fast), '
            '"tensor" (g = D, as in the paper) or "adjugate" (g = |D| D⁻¹), or no metric with operator="fick" (Fick\'s '
            "law). There is no default: choose one"
        )
    return metric  # type: ignore[return-value]


def checked_operator(operator: Any) -> OperatorChoice:
    """Return the name of an operator; raise ValueError for an unknown name."""
    if operator not in ("laplace-beltrami", "fick"):
        raise ValueError(f'operator: got {operator!r}; expected "laplace-beltrami" or "fick"')
    return operator


def checked_interpolation(interpolation: Any) -> Interpolation:
    """Return the name of an interpolation; raise ValueError for an unknown name."""
    if interpolation not in ("linear", "log-euclidean"):
        raise ValueError(f'interpolation: got {interpolation!r}; expected "linear" or "log-euclidean"')
    return interpolation


def require_grid(grid: Any) -> None:
    """Raise TypeError for anything that is not a grid."""
    if not isinstance(grid, Grid):
        remedy = ". Pass volume.grid() of a volume" * hasattr(grid, "grid")
        raise TypeError(f"grid: got {type(grid).__name__}; expected hks_jax.Grid{remedy}")


def tensors_on(grid: Any, name: str, tensors: Any) -> Float[Array, "*shape d d"]:
    """Return tensors at the nodes of a grid as floating-point numbers; raise ValueError for another shape."""
    require_grid(grid)
    array, expected = real_array(name, tensors), (*grid.shape, grid.dimension, grid.dimension)
    if array.shape != expected:
        raise ValueError(f"{name}: got shape {array.shape}; expected (*grid.shape, d, d) = {expected}")
    return array


_AT_ONCE = 1 << 17
"""The number of tensors checked at once; checks of 256³ tensors at once would take 7 GB."""


def require_spd(
    name: str, tensors: Float[np.ndarray, "*shape d d"], inside: Bool[np.ndarray, "*shape"], place: str
) -> None:
    """Raise ValueError unless the tensors inside the mask are finite, symmetric and positive definite.

    Messages call the location of a tensor by the word `place`: ``"node"`` on grids, ``"vertex"`` or others on meshes.
    """
    planes = max(_AT_ONCE * len(inside) // inside.size, 1)
    if len(inside) > planes:
        parts = [slice(first, first + planes) for first in range(0, len(inside), planes)]
        with contextlib.suppress(ValueError):  # the check of all tensors counts those that are wrong
            for part in parts:
                require_spd(name, tensors[part], inside[part], place)
            return
    require_finite_symmetric(name, tensors, inside, place)
    scaled, size = scaled_to_one(tensors)
    bad = inside & ~spd.is_spd(scaled)
    if bad.any():
        what = f"not positive definite, worst eigenvalue {least_eigenvalue(tensors[bad]):.3g}"
        of_grids = f"{_MASK}, or raise their eigenvalues (hks_jax.io.repair_tensors)"
        if bad.sum() > MANY * inside.sum():
            of_grids = (
                "Noise rarely makes this many tensors indefinite. If the tensors describe stress or strain, make a "
                f"metric by hks_jax.TensorField.from_indefinite. {_MASK}, if they are outside the domain"
            )
        refuse_tensors(name, bad, inside, place, what, of_grids if place == "node" else "Raise their eigenvalues")
    bad, digits = lost_determinants(scaled, size, tensors.dtype if tensors.dtype.kind == "f" else np.dtype(np.float64))
    bad &= inside
    if bad.any():
        about = f"about 1e{digits[bad][0]:.0f}, is beyond the accurate range of {tensors.dtype}"
        what = f"so small or large that their determinant, {about}"
        refuse_tensors(name, bad, inside, place, what, "Use another unit, in which the eigenvalues are near 1")


def scaled_to_one(
    tensors: Float[np.ndarray, "*shape d d"],
) -> tuple[Float[np.ndarray, "*shape d d"], Float[np.ndarray, "*shape"]]:
    """Return tensors divided by their largest absolute entries, and these entries; zero tensors are not divided."""
    size = np.abs(tensors).max(axis=(-2, -1))
    return tensors / np.where(size > 0, size, 1)[..., None, None], size


# Determinants are computed in the dtype of the tensors. XLA rounds numbers below the least normal one to zero, so such
# terms of a determinant are small enough only relative to a determinant that is larger by 1/ε. The terms have the order
# of the product of the largest entries, also if the determinant is much smaller.
def lost_determinants(
    scaled: Float[np.ndarray, "*shape d d"], size: Float[np.ndarray, "*shape"], dtype: np.dtype
) -> tuple[Bool[np.ndarray, "*shape"], Float[np.ndarray, "*shape"]]:
    """Mark positive definite tensors whose determinant underflows or overflows, and return its decimal logarithm.

    The tensors are given by the result of `scaled_to_one`.
    """
    d, limits = scaled.shape[-1], np.finfo(dtype)
    with np.errstate(divide="ignore", invalid="ignore"):  # outside the mask
        terms = d * np.log10(size.astype(np.float64))
        digits = np.log10(spd.determinant(scaled.astype(np.float64))) + terms
        lowest, highest = np.log10(limits.tiny) - np.log10(limits.eps), np.log10(limits.max) - 1
        return ~((digits > lowest) & (terms < highest)), digits


def require_finite_symmetric(
    name: str, tensors: Float[np.ndarray, "*shape d d"], inside: Bool[np.ndarray, "*shape"], place: str
) -> None:
    """Raise ValueError unless the tensors inside the mask are finite and symmetric; see `require_spd`."""
    bad = inside & ~np.isfinite(tensors).all(axis=(-2, -1))
    if bad.any():
        refuse_tensors(name, bad, inside, place, "NaN or infinite", _MASK if place == "node" else "Replace them")
    bad = inside & unsymmetric(tensors)
    if bad.any():
        what = "Pass (T + Tᵀ)/2 if the difference is noise, or check the component order"
        refuse_tensors(name, bad, inside, place, "unsymmetric", what)


_MASK = "Exclude these nodes by the grid's mask"


def unsymmetric(tensors: Float[np.ndarray, "*shape d d"]) -> Bool[np.ndarray, "*shape"]:
    """Mark the matrices that are unsymmetric beyond rounding in single precision."""
    skew = np.abs(tensors - np.swapaxes(tensors, -1, -2)).max(axis=(-2, -1))
    return skew > 1e-5 * np.abs(tensors).max(axis=(-2, -1))


def least_eigenvalue(tensors: Float[np.ndarray, "n d d"]) -> float:
    """Return the least eigenvalue of finite tensors; only their lower triangles are used."""
    return float(np.linalg.eigvalsh(tensors.astype(np.float64)).min())


def refuse_tensors(
    name: str, bad: Bool[np.ndarray, "*shape"], inside: Bool[np.ndarray, "*shape"], place: str, what: str, remedy: str
) -> NoReturn:
    """Raise ValueError about invalid tensors, with their number, the first place, the defect and the remedy."""
    first = tuple(int(i) for i in np.argwhere(bad)[0])
    raise ValueError(
        f"{name}: {int(bad.sum())} of {int(inside.sum())} tensors are {what} (the first at {place} {first}); "
        f"expected symmetric positive definite tensors. {remedy}"
    )


def right_cauchy_green(name: str, grid: Grid, F: Any) -> Float[Array, "*shape d d"]:
    """Return C = FᵀF of deformation gradients F (*shape, m, d), m ≥ d, and the identity outside the mask.

    Raises:
        ValueError: a wrong shape; square gradients whose determinant is not positive.
    """
    require_grid(grid)
    gradients, d = real_array(name, F), grid.dimension
    shape, (m, n) = gradients.shape[:-2], gradients.shape[-2:] if gradients.ndim >= 2 else (0, 0)
    if shape != grid.shape or n != d or m < d:
        expected = (*grid.shape, d, d)
        raise ValueError(
            f"{name}: got shape {gradients.shape}; expected one gradient per node, (*grid.shape, d, d) = {expected}, "
            f"or (*grid.shape, m, {d}) for a map into a space of m > {d} dimensions"
        )
    if m == d and not is_traced(gradients):
        known = np.asarray(gradients, np.float64)
        finite = grid.inside & np.isfinite(known).all(axis=(-2, -1))  # `require_spd` will find NaN in the metric
        determinants = np.linalg.det(np.where(finite[..., None, None], known, np.eye(d)))
        bad = finite & (determinants <= 0)
        if bad.any():
            first = tuple(int(i) for i in np.argwhere(bad)[0])
            raise ValueError(
                f"{name}: {int(bad.sum())} of {int(grid.inside.sum())} gradients have a determinant that is not "
                f"positive (the first is {determinants[first]:.3g} at node {first}); expected deformations that "
                f"preserve orientation. Check that {name}[..., i, j] is ∂yᵢ/∂xⱼ, or exclude these nodes by the mask"
            )
    inside = grid.inside[..., None, None]
    safe = jnp.where(inside, gradients, jnp.eye(m, d, dtype=gradients.dtype))
    return jnp.einsum("...ki,...kj->...ij", safe, safe, precision="highest")


PositiveMap = Literal["exp", "shift"]

MAPS: dict[str, str] = {
    "exp": "exp(S/s) with a scale s of your choice",
    "shift": "S + c·I with a shift c that makes it positive definite",
}
"""How messages describe each map from indefinite tensors S to a metric."""

NUMBERS = {"exp": "scale", "shift": "shift"}
"""The meaning of the argument `number` for each map from indefinite tensors to a metric."""


def positive_map(
    name: str,
    tensors: Any,
    how: PositiveMap | None,
    number: Any,
    inside: Bool[np.ndarray, "*shape"],
    place: str = "node",
) -> Float[Array, "*shape d d"]:
    """Return exp(S/s) or S + c·I, where `number` is s or c; outside the mask the identity replaces the tensor S.

    Raises:
        ValueError: an unknown map; NaN, infinite or unsymmetric tensors; an invalid scale or shift; a singular result.
    """
    if how not in NUMBERS:
        choices = " or ".join(f'"{choice}" ({does})' for choice, does in MAPS.items())
        raise ValueError(f"how: got {how!r}; expected {choices}. There is no default: choose one")
    if number is None:
        raise ValueError(f"number: got None; how={how!r} requires the {NUMBERS[how]}, in the units of {name}")
    require_number("number", number, above=0.0 if how == "exp" else -math.inf)
    tensors = real_array(name, tensors)
    known = not is_traced((tensors, number))
    if known:
        require_finite_symmetric(name, np.asarray(tensors), inside, place)
        values = np.linalg.eigvalsh(np.asarray(tensors, np.float64)[inside])
        got = f"number: got the {NUMBERS[how]} {float(number):g} for {name}"
        if how == "shift" and not float(number) + values.min() > 0:
            raise ValueError(
                f"{got} whose least eigenvalue is {values.min():g}; expected more than {-values.min():g}, so that "
                "S + c·I is positive definite"
            )
    symmetric = spd.symmetrise(spd.identity_outside(tensors, inside))
    number = jnp.asarray(number, tensors.dtype)
    eye = jnp.broadcast_to(jnp.eye(tensors.shape[-1], dtype=tensors.dtype), tensors.shape)
    mapped = spd.exp(symmetric / number) if how == "exp" else symmetric + number * eye
    if known and not spd.is_spd(np.asarray(mapped)[inside]).all():
        raise ValueError(
            f"{got} with eigenvalues from {values.min():.4g} to {values.max():.4g}: the metric is singular in "
            f"{mapped.dtype}; expected a larger number"
        )
    return mapped
