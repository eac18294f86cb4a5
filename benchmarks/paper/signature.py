"""The HKS of a field or a mesh, in one call."""

import math
import warnings
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from hks_jax.accuracy import AccuracyWarning
from hks_jax.domain.grid import Grid
from hks_jax.domain.simplicial_mesh import SimplicialMesh
from hks_jax.domain.tensor_field import TensorField
from hks_jax.eigen.driver import eigenpairs
from hks_jax.eigen.weyl import weyl_number
from hks_jax.fem.boundary import BoundarySpec
from hks_jax.signatures.hks import Normalisation, hks
from hks_jax.signatures.rim import boundary_influence
from hks_jax.spectrum_free.heat_diagonal import hks_spectrum_free

SMALL = 10_000
"""The number of nodes up to which selected inversion at one time is faster than computing the needed eigenpairs."""


def signature(
    domain: TensorField | SimplicialMesh,
    times: Sequence[float],
    k: int,
    boundary: BoundarySpec = "neumann",
    normalisation: Normalisation = "raw",
) -> Float[np.ndarray, "n_times *shape"]:
    """Return the HKS from k eigenpairs at the given times."""
    with warnings.catch_warnings():
        # The paper's domains are symmetric, so k often splits a multiple eigenvalue, whose effect is negligible.
        warnings.filterwarnings("ignore", "k = .* cuts a multiple eigenvalue", AccuracyWarning)
        pairs = eigenpairs(domain, k, boundary)
    return np.asarray(hks(pairs, np.asarray(times), normalisation))


def signature_and_influence(
    field: TensorField, times: Sequence[float], k: int
) -> tuple[Float[np.ndarray, "n_times *shape"], Float[np.ndarray, "n_times *shape"]]:
    """Return 4πt·HKS with the boundary condition "mean", and the boundary's influence on it."""
    pairs = eigenpairs(field, k, "mean", multiplet="drop")
    return np.asarray(hks(pairs, np.asarray(times), "flat")), np.asarray(boundary_influence(pairs, np.asarray(times)))


def enough_pairs(field: TensorField, time: float, boundary: str = "neumann", exponent: float = 8.0) -> int:
    """Return k such that exp(−λₖt) is about exp(−exponent), by Weyl's law for a square.

    For the boundary condition "mirror", the square is doubled along both axes to a torus of four times the area.
    """
    density = np.sqrt(np.linalg.det(np.asarray(field.domain_tensors)))
    area = float(np.sum(density[field.grid.inside]) * np.prod(field.grid.spacing))
    area, perimeter = (4 * area, 0.0) if boundary == "mirror" else (area, 4 * math.sqrt(area))
    return math.ceil(weyl_number(exponent / time, area, 2, perimeter))


def flat_signature(
    field: TensorField, time: float, boundary: str = "neumann", exponent: float = 8.0
) -> Float[np.ndarray, "*shape"]:
    """Return 4πt·HKS, which is 1 where a metric is flat and its boundary is far.

    On small grids, the HKS is computed from the whole spectrum; on large grids, from the pairs of `enough_pairs`.
    """
    if math.prod(field.grid.shape) > SMALL:
        return signature(field, [time], enough_pairs(field, time, boundary, exponent), boundary, "flat")[0]
    (values,) = hks_spectrum_free(field, [time], boundary, method="selected-inversion")
    return 4 * math.pi * time * np.asarray(values)


def continued_signature(field: TensorField, time: float, distance: float) -> Float[np.ndarray, "*shape"]:
    """Return 4πt·HKS of a metric that is given by a function, without the effect of its boundary.

    The HKS is computed on a grid that is extended by a strip of width `distance` in coordinates, and is cropped to the
    field's grid. The boundary of the extended grid affects only the strip.
    """
    grid = field.grid
    width = math.ceil(distance / min(grid.spacing))
    shape = [n + 2 * width for n in grid.shape]
    origin = [o - width * h for o, h in zip(grid.origin, grid.spacing, strict=True)]
    assert field.function is not None
    wide = TensorField.from_function(field.function, Grid(shape, grid.spacing, origin))
    return flat_signature(wide, time, exponent=7.0)[tuple(slice(width, width + n) for n in grid.shape)]
