"""The HKS of a field or a mesh, in one call."""

import math
import warnings
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from hks_jax.accuracy import AccuracyWarning
from hks_jax.domain.grid import Grid
from hks_jax.domain.surface_mesh import SurfaceMesh
from hks_jax.domain.tensor_field import TensorField
from hks_jax.eigen.solve import eigenpairs
from hks_jax.fem.boundary import BoundarySpec
from hks_jax.signatures.heat import Normalisation, hks


def signature(
    domain: TensorField | SurfaceMesh,
    times: Sequence[float],
    k: int,
    boundary: BoundarySpec = "neumann",
    normalisation: Normalisation = "raw",
) -> Float[np.ndarray, "n_times *shape"]:
    """Return the HKS of k eigenpairs at the given times."""
    with warnings.catch_warnings():
        # These domains are symmetric, and some multiple eigenvalue is always cut. All times here are such that
        # exp(−λₖt) makes the last pairs invisible.
        warnings.filterwarnings("ignore", "k = .* cuts a multiple eigenvalue", AccuracyWarning)
        pairs = eigenpairs(domain, k, boundary)
    return np.asarray(hks(pairs, np.asarray(times), normalisation))


def enough_pairs(field: TensorField, time: float, boundary: str = "neumann", exponent: float = 8.0) -> int:
    """Return k such that exp(−λₖt) is about exp(−exponent), by Weyl's law for a square.

    N(λ) ≈ (area·λ + perimeter·√λ)/4π with natural sides. A mirror has four times the area, and no sides.
    """
    density = np.sqrt(np.linalg.det(np.asarray(field.domain_tensors)))
    area = float(np.sum(density[field.grid.inside]) * np.prod(field.grid.spacing))
    scaled = area * exponent / time
    count = 4 * scaled if boundary == "mirror" else scaled + 4 * math.sqrt(scaled)
    return math.ceil(count / (4 * math.pi))


def continued_signature(field: TensorField, time: float, distance: float) -> Float[np.ndarray, "*shape"]:
    """Return the HKS of a metric given by a function, without boundary effect: continued beyond its grid.

    The function's formula is evaluated over a strip of the given width (coordinates) around the grid; what the sides
    of the wide grid do to the HKS is cut off with the strip.
    """
    grid = field.grid
    width = math.ceil(distance / min(grid.spacing))
    shape = [n + 2 * width for n in grid.shape]
    origin = [o - width * h for o, h in zip(grid.origin, grid.spacing, strict=True)]
    assert field.function is not None
    wide = TensorField.from_function(field.function, Grid(shape, grid.spacing, origin))
    (values,) = signature(wide, [time], enough_pairs(wide, time, exponent=7.0))
    return values[tuple(slice(width, width + n) for n in grid.shape)]
