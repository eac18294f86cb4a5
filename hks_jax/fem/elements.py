"""Elements: shape functions at quadrature points, element matrices, and points that cancel an error of signatures."""

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

    For q points, n nodes and d coordinates, `values` is (q, n), `gradients` is (q, n, d) and `weights` is (q,). The sum
    of the weights is the element's volume in coordinate units.
    """

    values: Float[np.ndarray, "q n"]
    gradients: Float[np.ndarray | Array, "q n d"]
    weights: Float[np.ndarray | Array, " q"]


def element_matrices(
    metric: Float[Array, "q d d"],
    density: Float[Array, " q"],
    element: Element,
    form: WeakForm,
    x: Float[Array, "q m"] | None,
    fields: Mapping[str, Array],
    jacobians: Float[Array, "q m d"] | None = None,
) -> tuple[Float[Array, "n n"], Float[Array, "n n"]]:
    """Return stiffness and mass of one element.

    The metric T, the density of the volume element (√|T| unless the operator is Fick's), the positions x and the fields
    are given at the quadrature points. If the Jacobians ∂x/∂ξ are given, gradients and metric in forms refer to the
    axes of space, otherwise to the element's coordinates ξ.
    """
    h, dh = jnp.asarray(element.values, metric.dtype), jnp.asarray(element.gradients, metric.dtype)
    volume = jnp.asarray(element.weights, metric.dtype) * density
    inverse = spd.inverse(metric)
    if jacobians is not None:
        product = partial(jnp.einsum, precision="highest")
        dual = product("qxa,qab->qxb", jacobians, spd.inverse(product("qxa,qxb->qab", jacobians, jacobians)))
        dh = product("qxa,qia->qix", dual, dh)
        metric, inverse = (product("qxa,qab,qyb->qxy", f, t, f) for f, t in ((dual, metric), (jacobians, inverse)))
    functions = of_components(ShapeFunction(h, dh), form.components)
    points = Point(metric, inverse, x, fields)
    stiffness, mass = (integrate(each, volume, functions, points) for each in (form.stiffness, form.mass))
    return (stiffness, mass) if form.checked else (symmetric_or_nan(stiffness), symmetric_or_nan(mass))


GAUSS = 1 / math.sqrt(3)
"""The coordinate ξ of the two Gauss points ±ξ on [−1, 1]."""


@lru_cache(maxsize=4)
def tensor_product_element(dimension: int, point: float = GAUSS) -> Element:
    """Return the Q1 element on the unit square or cube, with quadrature points at ±``point`` on each axis of [−1, 1]^d.

    Nodes and points are in the order of ``itertools.product((0, 1), repeat=d)``.
    """
    near, far = (1 + point) / 2, (1 - point) / 2
    h, dh = np.array([[near, far], [far, near]]), np.array([[-1.0, 1.0], [-1.0, 1.0]])  # (point, node) of the interval
    axes, n = range(dimension), 2**dimension
    gradients = [reduce(np.kron, [dh if a == b else h for b in axes]) for a in axes]
    return Element(reduce(np.kron, [h] * dimension), np.stack(gradients, axis=-1), np.full(n, 1 / n))


# The d + 1 quadrature points have equal weights. One barycentric coordinate of each quadrature point is 1 − d·a, and
# the other d coordinates equal a. The rule is exact for polynomials of degree two if the product of two coordinates has
# the mean 1/((d + 1)(d + 2)) over the points: 2a(1 − d·a) + (d − 1)a² = 1/(d + 2), where the smaller a is ``beside``.
def _linear_rule(d: int) -> tuple[Float[np.ndarray, "q n"], Float[np.ndarray, " q"]]:
    beside = (d + 2 - math.sqrt(d + 2)) / ((d + 1) * (d + 2))
    points = np.full((d + 1, d + 1), beside) + (1 - (d + 1) * beside) * np.eye(d + 1)
    return points, np.full(d + 1, 1 / math.factorial(d + 1))


# Radon's rule has 7 points in a triangle: the centre, three points near the corners and three near the midpoints of the
# edges. Keast's rule has 15 points in a tetrahedron: the centre, four points near the corners, four near the centres of
# the faces and six near the midpoints of the edges. Radon's and Keast's rules are exact for polynomials of degree five.
def _quadratic_rule(d: int) -> tuple[Float[np.ndarray, "q n"], Float[np.ndarray, " q"]]:
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
    """Return the P1 or P2 element on the unit triangle or tetrahedron; the mass is exact if edges are straight.

    The nodes of P2 are the corners, followed by the midpoints of the edges in the order of `Triangulation.cell_edges`.
    """
    points, weights = (_linear_rule if degree == 1 else _quadratic_rule)(dimension)
    slopes = np.concatenate([-np.ones((1, dimension)), np.eye(dimension)])  # gradients of barycentric coordinates
    if degree == 1:
        return Element(points, np.stack([slopes] * len(points)), weights)
    a, b = np.array(list(combinations(range(dimension + 1), 2))).T
    values = np.concatenate([points * (2 * points - 1), 4 * points[:, a] * points[:, b]], axis=1)
    of_corners = (4 * points - 1)[..., None] * slopes
    of_edges = 4 * (points[:, a, None] * slopes[b] + points[:, b, None] * slopes[a])
    return Element(values, np.concatenate([of_corners, of_edges], axis=1), weights)


Quadrature = Literal["gauss", "cancelling"]

MASS = math.sqrt(2 / 3)
"""The coordinate ξ of the points ±ξ on each axis of [−1, 1]^d at which a cancelling mass evaluates shape functions."""
_LEAST, _GREATEST = 0.01, 1.0
"""Bounds of ξ² that keep the quadrature points of the stiffness inside the cell, but away from its centre, where
hourglass modes (alternating nodal values) have no energy."""


# Derivation for a constant tensor T = A⁻¹: on a grid with the spacing hₐ along axis a, a plane wave with the wave
# vector k changes its phase by θₐ = kₐhₐ between neighbouring nodes. The symbol of a matrix is the factor by which the
# matrix multiplies a plane wave. If the mass has the quadrature points ±ξ, its symbol along one axis is 1 − μθ² +
# O(θ⁴), where μ = (1 − ξ²)/4. In the stiffness, a product of two derivatives has the symbol k²(1 − θ²/12), and a
# derivative times a value has the symbol (sin θ)/h, both for every ξ. Along an axis without a derivative, the stiffness
# has the symbol 1 − νθ² + O(θ⁴), where ν = (1 − ξ²)/4 for the points ±ξ of the stiffness. The exact eigenvalue of the
# wave is λ = Σ Aₐᵦkₐkᵦ, and its discrete eigenvalue is, to leading order,
#
#     λ + λ μ Σₐ θₐ² − Σₐ Aₐₐkₐ² (θₐ²/12 + ν Σ_{b≠a} θᵦ²) − Σ_{a<b} 2Aₐᵦkₐkᵦ ((θₐ² + θᵦ²)/6 + ν Σ_{c≠a,b} θ_c²).
#
# With the coefficients μ = 1/12 of the mass and ν = 1/12 of the stiffness, the eigenvalue has the error
# −Σ_{a<b} 2Aₐᵦkₐkᵦ (θₐ² + θᵦ²)/12, which is zero for a diagonal tensor. For a tensor that is not diagonal, no stencil
# with 3^d couplings cancels the error of every plane wave. But the coefficient ν = 1/12 + δ of the stiffness cancels
# the mean of the error over the heat kernel, in which the phases θ are normally distributed with a covariance
# proportional to Sₐᵦ = hₐhᵦTₐᵦ. Since θₐ = hₐkₐ, Aₐᵦkₐkᵦ = Bₐᵦθₐθᵦ with B = S⁻¹. Isserlis' theorem for
# expectations, E θₐθᵦθ_cθ_e = SₐᵦS_ce + Sₐ_cSᵦ_e + Sₐ_eSᵦ_c, gives the correction
#
#     δ = −(1/12) Σ_{a<b} 2Bₐᵦ E(θₐ³θᵦ + θₐθᵦ³) / (Σ_{a≠b} Bₐₐ E θₐ²θᵦ² + Σ_{a<b} Σ_{c≠a,b} 2Bₐᵦ E θₐθᵦθ_c²).
#
# The correction δ depends neither on the time t nor on the size of the matrix S. In two dimensions
# δ = S₁₂²/2(S₁₁S₂₂ + 2S₁₂²), so that ξ² = 2/3 − 4δ for the points ±ξ of the stiffness is between 0 and 2/3. The
# denominator of the correction is positive, because it equals the expectation Σ_c E(θ_c² Σ_{a,b≠c} Bₐᵦθₐθᵦ).
#
# The mass makes nodal values of functions of norm 1 too large by the factor 1 + Σ μθₐ²/2, which `Pencil.read` corrects.
def stiffness_point(metric: Float[Array, "d d"], spacing: Float[np.ndarray | Array, " d"]) -> Float[Array, ""]:
    """Return ξ² for the quadrature points ±ξ of the stiffness in a cell with this metric."""
    s = metric * spacing[:, None] * spacing[None]
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


# The stiffness evaluates shape functions at its quadrature points ±ξ, but tensors at Gauss points, which integrate
# tensors accurately. With tensors at the points ±ξ, the errors of signatures of brain images were twice as large.
#
# On a cell, a function is a linear combination of products of coordinates, one for each set of axes. The derivative of
# a product of m coordinates is a product of m − 1 coordinates, which are ±ξ at the quadrature points. If the derivative
# of each product of m coordinates is multiplied by (ξ/ξ₀)^(m−1), the stiffness for Gauss points ±ξ₀ becomes the
# stiffness for points ±ξ. The products of coordinates are orthogonal, because their values at the corners are ±1.
def moved(
    stiffness: Float[Array, "n n"], metric: Float[Array, "q d d"], spacing: Float[np.ndarray | Array, " d"]
) -> Float[Array, "n n"]:
    """Convert the stiffness of a cell from Gauss points to the quadrature points that `stiffness_point` determines."""
    ratio = jnp.sqrt(stiffness_point(jnp.mean(metric, axis=0), spacing)) / GAUSS
    basis, powers = (jnp.asarray(each, stiffness.dtype) for each in _products_of_coordinates(len(spacing)))
    factors = ratio**powers
    inner = jnp.matmul(stiffness.ravel(), basis, precision="highest") * jnp.outer(factors, factors).ravel()
    return jnp.matmul(inner, basis, precision="highest").reshape(stiffness.shape)


@lru_cache(maxsize=2)
def _products_of_coordinates(dimension: int) -> tuple[Float[np.ndarray, "nn nn"], Float[np.ndarray, " n"]]:
    one = np.array([[1.0, 1.0], [1.0, -1.0]]) / np.sqrt(2)
    basis = reduce(np.kron, [one] * 2 * dimension)
    degrees = np.indices((2,) * dimension).sum(axis=0).ravel()
    return basis, np.maximum(degrees - 1.0, 0.0)
