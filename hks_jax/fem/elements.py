"""The element: shape functions at quadrature points, and the integrals of one element."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache, partial, reduce
from itertools import combinations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.domain import spd
from hks_jax.fem.forms import Point, ShapeFunction, WeakForm, integrate, of_components, symmetric_or_nan


@dataclass(frozen=True, eq=False)
class Element:
    """Shape functions tabulated at the quadrature points of a reference element.

    `values` (q, n), `gradients` (q, n, d), `weights` (q,): q points, n nodes, d coordinates. The weights include the
    element's volume in coordinate units.
    """

    values: Float[np.ndarray, "q n"]
    gradients: Float[np.ndarray | Array, "q n d"]
    weights: Float[np.ndarray | Array, " q"]

    def stretched(self, sides: tuple[float, ...]) -> "Element":
        """Return the element with its sides multiplied by these lengths."""
        return Element(self.values, self.gradients / np.array(sides), self.weights * math.prod(sides))


def element_matrices(
    metric: Float[Array, "q d d"],
    element: Element,
    form: WeakForm = WeakForm(),  # noqa: B008
    x: Float[Array, "q m"] | None = None,
    fields: Mapping[str, Array] | None = None,
    frames: Float[Array, "q m d"] | None = None,
) -> tuple[Float[Array, "n n"], Float[Array, "n n"]]:
    """Integrate one element: by default stiffness ∫ √|T| T⁻¹∇hᵢ·∇hⱼ and mass ∫ √|T| hᵢhⱼ.

    The metric T, positions x and fields are those at the quadrature points. With frames ∂x/∂ξ of the element's
    coordinates ξ the forms see places x in space; else they see ξ.
    """
    h, dh = jnp.asarray(element.values, metric.dtype), jnp.asarray(element.gradients, metric.dtype)
    volume = jnp.asarray(element.weights, metric.dtype) * jnp.sqrt(spd.determinant(metric))
    inverse = spd.inverse(metric)
    if frames is not None:
        product = partial(jnp.einsum, precision="highest")
        dual = product("qxa,qab->qxb", frames, spd.inverse(product("qxa,qxb->qab", frames, frames)))
        dh = product("qxa,qia->qix", dual, dh)
        metric, inverse = (product("qxa,qab,qyb->qxy", f, t, f) for f, t in ((dual, metric), (frames, inverse)))
    functions = of_components(ShapeFunction(h, dh), form.components)
    points = Point(metric, inverse, x, fields or {})
    stiffness, mass = (integrate(each, volume, functions, points) for each in (form.stiffness, form.mass))
    return (stiffness, mass) if form.checked else (symmetric_or_nan(stiffness), symmetric_or_nan(mass))


def at_quadrature(nodal: Float[Array, "n d d"], element: Element) -> Float[Array, "q d d"]:
    """Interpolate nodal tensors to the quadrature points with the element's own shape functions."""
    return jnp.einsum("qn,nab->qab", jnp.asarray(element.values, nodal.dtype), nodal, precision="highest")


GAUSS = 1 / math.sqrt(3)
"""ξ of Gauss's two points ±ξ on [−1, 1]."""


@lru_cache(maxsize=4)
def tensor_product_element(dimension: int, point: float = GAUSS) -> Element:
    """Return the Q1 element (bilinear, trilinear) on the unit square or cube, with points at ±``point`` of [−1, 1]^d.

    Nodes and points are in the order of ``itertools.product((0, 1), repeat=d)``.
    """
    near, far = (1 + point) / 2, (1 - point) / 2
    h, dh = np.array([[near, far], [far, near]]), np.array([[-1.0, 1.0], [-1.0, 1.0]])  # (point, node) of the interval
    axes, n = range(dimension), 2**dimension
    gradients = [reduce(np.kron, [dh if a == b else h for b in axes]) for a in axes]
    return Element(reduce(np.kron, [h] * dimension), np.stack(gradients, axis=-1), np.full(n, 1 / n))


# With d + 1 points, one beside each corner, whose barycentric coordinates are 1 − d·a and d times a, the rule of equal
# weights is exact for polynomials of degree two if Σ over the points of hᵢhⱼ has the mean 1/((d + 1)(d + 2)), i ≠ j:
# 2a(1 − d·a) + (d − 1)a² = 1/(d + 2), whose smaller solution is the a below.
def _linear_rule(d: int) -> tuple[Float[np.ndarray, "q n"], Float[np.ndarray, " q"]]:
    """Return barycentric coordinates and weights, exact for degree two."""
    beside = (d + 2 - math.sqrt(d + 2)) / ((d + 1) * (d + 2))
    points = np.full((d + 1, d + 1), beside) + (1 - (d + 1) * beside) * np.eye(d + 1)
    return points, np.full(d + 1, 1 / math.factorial(d + 1))


# Radon's rule of 7 points for triangles, and Keast's of 15 for tetrahedra: the centre; two orbits of points beside the
# corners; in 3D one beside the middles of the edges.
def _quadratic_rule(d: int) -> tuple[Float[np.ndarray, "q n"], Float[np.ndarray, " q"]]:
    """Return barycentric coordinates and weights, exact for degree five."""
    root, n = math.sqrt(15), d + 1
    points, weights = [np.full((1, n), 1 / n)], [[9 / 80 if d == 2 else 8 / 405]]
    for sign in (1, -1):
        beside = (6 + sign * root) / 21 if d == 2 else (7 + sign * root) / 34
        weight = (155 + sign * root) / 2400 if d == 2 else (2665 - sign * 14 * root) / 226800
        points.append(np.full((n, n), beside) + (1 - n * beside) * np.eye(n))
        weights.append([weight] * n)
    if d == 3:
        near = (5 + root) / 20
        corners = np.array(list(combinations(range(4), 2)))
        orbit = np.full((6, 4), 0.5 - near)
        np.put_along_axis(orbit, corners, near, axis=1)
        points.append(orbit)
        weights.append([5 / 567] * 6)
    return np.concatenate(points), np.concatenate(weights)


@lru_cache(maxsize=4)
def simplex_element(dimension: int, degree: int = 1) -> Element:
    """Return the P1 or P2 element on the unit triangle or tetrahedron; the mass is exact where sides are straight.

    The nodes of P2 are the corners, then the middles of the edges in the order of `Triangulation.cell_edges`.
    """
    points, weights = (_linear_rule if degree == 1 else _quadratic_rule)(dimension)
    slopes = np.concatenate([-np.ones((1, dimension)), np.eye(dimension)])  # of the barycentric coordinates
    if degree == 1:
        return Element(points, np.stack([slopes] * len(points)), weights)
    a, b = np.array(list(combinations(range(dimension + 1), 2))).T
    values = np.concatenate([points * (2 * points - 1), 4 * points[:, a] * points[:, b]], axis=1)
    of_corners = (4 * points - 1)[..., None] * slopes
    of_edges = 4 * (points[:, a, None] * slopes[b] + points[:, b, None] * slopes[a])
    return Element(values, np.concatenate([of_corners, of_edges], axis=1), weights)
