"""The integrals of small grids, and their derivative with respect to the tensors, by NumPy."""

from collections.abc import Callable
from itertools import product
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Array, Bool, Float

from hks_jax.compilation import is_concrete_on_cpu
from hks_jax.domain import spd
from hks_jax.domain.tensor_checks import Interpolation
from hks_jax.fem.elements import tensor_product_element
from hks_jax.fem.forms import WeakForm
from hks_jax.fem.space import cells_of
from hks_jax.linear.linear_program import HostMap

_ON_HOST = {2: 1 << 19, 3: 1 << 23}
"""NumPy integrates up to this total number of entries of the matrices of all elements in the domain, by dimension: 181²
or 50³ elements. NumPy needs no compilation and no elements outside the domain; in 3D, its derivatives take half of the
time of compiled ones."""

Integrals: TypeAlias = tuple[Any, Any, Any, Any]
"""Stiffness and mass as stencils (as element matrices for vectors), the mass's row sums, and the metric's volume."""


class Settings(NamedTuple):
    """The static properties of the integrals."""

    periodic: tuple[bool, ...]
    interpolation: Interpolation
    operator: WeakForm


class Geometry(NamedTuple):
    """The arrays that describe a grid and its element; x has the positions of the quadrature points, if needed."""

    domain: Bool[np.ndarray | Array, "*shape"]
    elements: Bool[np.ndarray | Array, "*elements"]
    couplings: Bool[np.ndarray | Array, "offsets *shape"] | None
    gradients: Float[np.ndarray | Array, "q n d"]
    weights: Float[np.ndarray | Array, " q"]
    spacing: Float[np.ndarray | Array, " d"]
    x: Float[Array, "*elements q d"] | None


class HostIntegrals(NamedTuple):
    """The integrals as a function of the tensors, and its derivative."""

    value: Callable[[], Integrals]
    derivative: HostMap


def host_integrals(
    settings: Settings, geometry: Geometry, tensors: Float[Array, "*shape d d"], fields: dict[str, Any]
) -> HostIntegrals | None:
    """Return the integrals of a field without densities, potentials or forms of the user's; otherwise None.

    The result is also None if the tensors are interpolated by logarithms, traced, not on a CPU, or too many.
    """
    (periodic, interpolation, operator), (domain, elements, coupled, gradients, weights, *_) = settings, geometry
    plain = operator == WeakForm(lumped=operator.lumped, fick=operator.fick) and not fields
    if not (plain and interpolation == "linear" and is_concrete_on_cpu((geometry, tensors))):
        return None
    if 4 ** len(periodic) * np.sum(elements) > _ON_HOST[len(periodic)]:
        return None
    d, n, dtype, shape = len(periodic), 2 ** len(periodic), tensors.dtype, domain.shape
    h, nodes = tensor_product_element(d).values.astype(dtype), np.asarray(tensors).reshape(-1, d, d)
    corners = np.array(list(product((0, 1), repeat=d)))
    offsets = (corners[None] - corners[:, None] + 1) @ 3 ** np.arange(d)[::-1]
    cells = cells_of(np.asarray(elements), shape, periodic)
    places = cells[:, :, None] + offsets * domain.size
    of_stiffness = np.einsum("q,qia,qjb->qabij", weights, gradients, gradients).reshape(-1, n * n)
    of_mass = np.einsum("q,qi,qj->qij", weights, h, h).reshape(-1, n * n)
    coupled = np.ones((), bool) if coupled is None else coupled
    # Nodes outside the domain have no influence, whatever their tensors are.
    valid = np.where(domain.ravel(), np.where(spd.is_spd(nodes), 1, np.nan), 0).astype(dtype)[:, None, None]

    def inside(nodal: np.ndarray) -> np.ndarray:
        at_corners = (nodal * valid)[cells].reshape(-1, n, d * d)
        return np.matmul(h, at_corners).reshape(-1, n, d, d)

    def integrals(flux: np.ndarray, density: np.ndarray, metric_density: np.ndarray) -> tuple[Any, ...]:
        of_elements = flux.reshape(len(cells), -1) @ of_stiffness, density @ of_mass
        sums = (np.bincount(places.ravel(), each.ravel(), 3**d * domain.size) for each in of_elements)
        stiffness, mass = (each.astype(dtype).reshape(3**d, *shape) for each in sums)
        couplings = np.where(coupled, stiffness, 0), np.where(coupled, mass, 0)
        return *couplings, mass.sum(axis=0), np.sum(metric_density @ weights)

    # The integrands of a metric T have d(√|T| T⁻¹) = √|T| (½ tr(T⁻¹dT) T⁻¹ − T⁻¹dT T⁻¹) and d√|T| = ½√|T| tr(T⁻¹dT).
    # The integrands of Fick's operator, whose tensors are D, are D and 1, and |D|^(−½) for the volume of the metric.
    given, fick = inside(nodes), operator.fick
    root, inverse = np.sqrt(spd.determinant(given)), spd.inverse(given)
    flux, across = given if fick else root[..., None, None] * inverse, np.swapaxes(inverse, -1, -2)

    def value() -> Integrals:
        return integrals(flux, np.ones_like(root) if fick else root, 1 / root if fick else root)

    def apply(changes: tuple[Any, Any]) -> Integrals:
        change = inside(np.asarray(changes[0]).reshape(-1, d, d))
        half = np.sum(across * change, axis=(-2, -1)) / 2
        if fick:
            return integrals(change, np.zeros_like(root), -half / root)
        return integrals(half[..., None, None] * flux - flux @ change @ inverse, root * half, root * half)

    def transpose(like: tuple[Any, Any], y: Integrals) -> tuple[Any, Any]:
        stiffness, mass = np.where(coupled, y[0], 0), np.where(coupled, y[1], 0) + y[2]
        of_flux, of_root = (
            each.ravel()[places].reshape(-1, n * n) @ table.T
            for each, table in ((stiffness, of_stiffness), (mass, of_mass))
        )
        of_flux, of_volume = of_flux.reshape(given.shape), y[3] * weights
        if fick:
            of_tensors = of_flux - (of_volume / (2 * root))[..., None, None] * across
        else:
            half = (np.sum(flux * of_flux, axis=(-2, -1)) + root * (of_root + of_volume)) / 2
            of_tensors = half[..., None, None] * across - root[..., None, None] * across @ of_flux @ across
        of_corners = np.matmul(h.T, of_tensors.reshape(-1, n, d * d)).reshape(-1, d * d)
        sums = [np.bincount(cells.ravel(), each, domain.size) for each in of_corners.T]
        of_nodes = np.stack(sums, axis=-1).reshape(-1, d, d) * valid
        return of_nodes.astype(dtype).reshape(tensors.shape), like[1]

    return HostIntegrals(value, HostMap(apply, transpose))
