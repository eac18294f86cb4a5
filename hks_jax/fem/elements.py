"""The element: shape functions at quadrature points, and the integrals of one element."""

import math
from dataclasses import dataclass
from functools import lru_cache
from itertools import product

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.domain import spd


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
        """Return the element whose sides are so many times as long."""
        return Element(self.values, self.gradients / np.array(sides), self.weights * math.prod(sides))


def element_matrices(
    metric: Float[Array, "q d d"], element: Element
) -> tuple[Float[Array, "n n"], Float[Array, "n n"]]:
    """Integrate one element: stiffness ∫ √|T| T⁻¹∇hᵢ·∇hⱼ and mass ∫ √|T| hᵢhⱼ.

    Args:
        metric: T at the quadrature points.
        element: the shape functions there.

    Returns:
        stiffness (n, n) and mass (n, n).
    """
    h, dh = jnp.asarray(element.values, metric.dtype), jnp.asarray(element.gradients, metric.dtype)
    volume = jnp.asarray(element.weights, metric.dtype) * jnp.sqrt(spd.determinant(metric))
    flux = jnp.einsum("qab,qjb->qja", spd.inverse(metric), dh, precision="highest")
    stiffness = jnp.einsum("q,qia,qja->ij", volume, dh, flux, precision="highest")
    mass = jnp.einsum("q,qi,qj->ij", volume, h, h, precision="highest")
    return stiffness, mass


def at_quadrature(nodal: Float[Array, "n d d"], element: Element) -> Float[Array, "q d d"]:
    """Interpolate nodal tensors to the quadrature points with the element's own shape functions."""
    return jnp.einsum("qn,nab->qab", jnp.asarray(element.values, nodal.dtype), nodal, precision="highest")


@lru_cache(maxsize=2)
def tensor_product_element(dimension: int) -> Element:
    """Return the Q1 element (bilinear, trilinear) with 2^d Gauss points on the unit square or cube.

    Nodes and points are in the order of ``itertools.product((0, 1), repeat=d)``.
    """
    gauss = 0.5 + np.array([-0.5, 0.5]) / np.sqrt(3.0)
    h = np.stack([1 - gauss, gauss], axis=1)  # (point, node) of the unit interval
    dh = np.array([[-1.0, 1.0], [-1.0, 1.0]])
    d, corners = dimension, list(product((0, 1), repeat=dimension))
    n = len(corners)
    values, gradients = np.ones((n, n)), np.ones((n, n, d))
    for (q, point), (i, node) in product(enumerate(corners), enumerate(corners)):
        for a in range(d):
            values[q, i] *= h[point[a], node[a]]
            for b in range(d):
                gradients[q, i, b] *= (dh if a == b else h)[point[a], node[a]]
    return Element(values, gradients, np.full(n, 1 / n))


# With d + 1 points, one beside each corner, whose barycentric coordinates are 1 − d·a and d times a, the rule of equal
# weights is exact for polynomials of degree two if Σ over the points of hᵢhⱼ has the mean 1/((d + 1)(d + 2)), i ≠ j:
# 2a(1 − d·a) + (d − 1)a² = 1/(d + 2), whose smaller solution is the a below.
@lru_cache(maxsize=2)
def simplex_element(dimension: int) -> Element:
    """Return the P1 element on the unit triangle or tetrahedron, with d + 1 points: exact for the mass."""
    d = dimension
    beside = (d + 2 - math.sqrt(d + 2)) / ((d + 1) * (d + 2))
    values = np.full((d + 1, d + 1), beside) + (1 - (d + 1) * beside) * np.eye(d + 1)
    gradients = np.concatenate([-np.ones((1, d)), np.eye(d)])
    weights = np.full(d + 1, 1 / math.factorial(d + 1))
    return Element(values, np.stack([gradients] * (d + 1)), weights)
