"""The element: shape functions at quadrature points, the integrals of one, and points at which its error cancels."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache, partial, reduce
from itertools import combinations
from typing import Literal

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


Quadrature = Literal["gauss", "cancelling"]

MASS = math.sqrt(2 / 3)
"""ξ of the two points ±ξ along each axis of [−1, 1]^d at which the mass takes shape functions."""
_LEAST, _GREATEST = 0.01, 1.0
"""Between these is ξ² of the stiffness: inside the cell, and not in its centre, where hourglasses have no energy."""


# Take a constant tensor, A = T⁻¹, spacings hₐ, a plane wave of wave vector k, and θₐ = kₐhₐ. The rule of points ±ξ with
# μ = (1 − ξ²)/4 gives the mass along one axis the symbol 1 − μθ² + O(θ⁴). In the stiffness ∂h∂h' has k²(1 − θ²/12), and
# ∂h h' has (sin θ)/h whatever ξ is. With μ in the mass and ν in the stiffness (along the axes in which it does not
# differentiate) the eigenvalue λ = Σ Aₐᵦkₐkᵦ becomes, to leading order,
#
#     λ + λ μ Σₐ θₐ² − Σₐ Aₐₐkₐ² (θₐ²/12 + ν Σ_{b≠a} θᵦ²) − Σ_{a<b} 2Aₐᵦkₐkᵦ ((θₐ² + θᵦ²)/6 + ν Σ_{c≠a,b} θ_c²).
#
# μ = ν = 1/12 leaves −Σ_{a<b} 2Aₐᵦkₐkᵦ (θₐ² + θᵦ²)/12 of it: nothing where the tensor is diagonal. Elsewhere 3^d
# couplings a node cannot cancel that for every k, but ν = 1/12 + δ can in the mean that the heat kernel takes, in which
# θ is normal with a covariance proportional to S, Sₐᵦ = hₐhᵦTₐᵦ. With A now the inverse of S, and Isserlis' theorem
# E θₐθᵦθ_cθ_e = SₐᵦS_ce + Sₐ_cSᵦ_e + Sₐ_eSᵦ_c,
#
#     δ = −(1/12) Σ_{a<b} 2Aₐᵦ E(θₐ³θᵦ + θₐθᵦ³) / (Σ_{a≠b} Aₐₐ E θₐ²θᵦ² + Σ_{a<b} Σ_{c≠a,b} 2Aₐᵦ E θₐθᵦθ_c²);
#
# neither t nor the size of S matters. In the plane δ = S₁₂²/2(S₁₁S₂₂ + 2S₁₂²), so that ξ² = 2/3 − 4δ is between 0 and
# 2/3. The denominator is positive: E θ_c² times the energy of the other axes, summed over c.
#
# Functions of norm 1 have nodal values that are too large by the factor 1 + Σ μθₐ²/2: `Pencil.read` undoes that.
def stiffness_point(metric: Float[Array, "d d"], spacing: Float[np.ndarray | Array, " d"]) -> Float[Array, ""]:
    """Return ξ² of the points of the stiffness in a cell with this metric."""
    s = metric * spacing[:, None] * spacing
    d = len(s)
    s = d * s / jnp.trace(s)
    a = spd.adjugate(s)
    numerator, denominator = jnp.zeros((), s.dtype), jnp.zeros((), s.dtype)
    for i, j in combinations(range(d), 2):
        both = a[i, i] + a[j, j]
        numerator += 6 * a[i, j] * s[i, j] * (s[i, i] + s[j, j])
        denominator += both * (s[i, i] * s[j, j] + 2 * s[i, j] ** 2)
        for c in {*range(d)} - {i, j}:
            denominator += 2 * a[i, j] * (s[i, j] * s[c, c] + 2 * s[i, c] * s[j, c])
    return jnp.clip(2 / 3 + numerator / (3 * denominator), _LEAST, _GREATEST)


# Only the shape functions are taken at these points. The tensors stay those at Gauss's points, by which their own
# integrals over a cell are right: with tensors at the points themselves, errors on brains were twice as large.
#
# On a cell a function is a sum of products of coordinates, one for every set of axes, and a derivative along one axis
# leaves the coordinates of the others, which grow with ξ. So the stiffness at other points is Gauss's with products of
# m coordinates times (ξ/ξ₀)^(m−1). By their values at the corners, 1 or −1, the products are orthogonal.
def moved(
    stiffness: Float[Array, "n n"], metric: Float[Array, "q d d"], spacing: Float[np.ndarray | Array, " d"]
) -> Float[Array, "n n"]:
    """Return a cell's stiffness, integrated at Gauss's points, as one at the points that its tensor asks for."""
    ratio = jnp.sqrt(stiffness_point(jnp.mean(metric, axis=0), spacing)) / GAUSS
    basis, powers = (jnp.asarray(each, stiffness.dtype) for each in _products_of_coordinates(len(spacing)))
    factors = ratio**powers
    inner = jnp.matmul(stiffness.ravel(), basis, precision="highest") * jnp.outer(factors, factors).ravel()
    return jnp.matmul(inner, basis, precision="highest").reshape(stiffness.shape)


@lru_cache(maxsize=2)
def _products_of_coordinates(dimension: int) -> tuple[Float[np.ndarray, "nn nn"], Float[np.ndarray, " n"]]:
    """Return what takes matrices to the basis of products of coordinates and back, and m − 1 for each; 0 for m = 0."""
    one = np.array([[1.0, 1.0], [1.0, -1.0]]) / np.sqrt(2)
    basis = reduce(np.kron, [one] * 2 * dimension)
    degrees = np.indices((2,) * dimension).sum(axis=0).ravel()
    return basis, np.maximum(degrees - 1.0, 0.0)
