"""Elements of grids whose leading error cancels: quadrature points chosen in each cell from its tensor."""

import math
from functools import lru_cache, reduce
from itertools import combinations
from typing import Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hks_jax.domain import spd
from hks_jax.fem.elements import GAUSS

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
    basis, powers = (jnp.asarray(each, stiffness.dtype) for each in _products(len(spacing)))
    factors = ratio**powers
    inner = jnp.matmul(stiffness.ravel(), basis, precision="highest") * jnp.outer(factors, factors).ravel()
    return jnp.matmul(inner, basis, precision="highest").reshape(stiffness.shape)


@lru_cache(maxsize=2)
def _products(dimension: int) -> tuple[Float[np.ndarray, "nn nn"], Float[np.ndarray, " n"]]:
    """Return what takes matrices to the basis of products of coordinates and back, and m − 1 for each; 0 for m = 0."""
    one = np.array([[1.0, 1.0], [1.0, -1.0]]) / np.sqrt(2)
    basis = reduce(np.kron, [one] * 2 * dimension)
    degrees = np.indices((2,) * dimension).sum(axis=0).ravel()
    return basis, np.maximum(degrees - 1.0, 0.0)
