"""The fields of Zobel, Reininghaus and Hotz (the paper), and charts of surfaces with a geometry in closed form.

All fields are made from functions, so that their curvature is exact. Angles are in radians.
"""

from collections.abc import Callable, Sequence
from functools import partial
from math import pi

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hks_jax.checks import require_count
from hks_jax.domain.geodesic import geodesic
from hks_jax.domain.grid import Grid
from hks_jax.domain.simplicial_mesh import SurfaceMesh, TetMesh
from hks_jax.domain.tensor_field import TensorField

Point = Float[Array, " d"]
Metric = Callable[[Point], Float[Array, "d d"]]


def pullback(parametrisation: Callable[[Point], Float[Array, " m"]]) -> Metric:
    """Return the pullback metric x ↦ JᵀJ of a map from coordinates (d,) into space (m,), where J is the map's Jacobian.

    Examples:
        >>> metric = hj.examples.pullback(lambda x: x[0] * jnp.stack([jnp.cos(x[1]), jnp.sin(x[1])]))
        >>> print(metric(jnp.array([2.0, 0.5])).diagonal().round(3))  # dr² + r² dθ²
        [1. 4.]
    """

    def metric(x: Point) -> Float[Array, "d d"]:
        jacobian = jax.jacfwd(parametrisation)(x)
        return jnp.matmul(jacobian.T, jacobian, precision="highest")

    return metric


def torus(x: Float[Array, " 2"], major: float | Array, minor: float | Array) -> Float[Array, " 3"]:
    """Return the point of a torus of revolution; x₁ is the angle around its axis, x₂ the angle around its tube.

    Examples:
        >>> print(hj.examples.torus(jnp.zeros(2), 2.0, 1.0))
        [3. 0. 0.]
    """
    ring = major + minor * jnp.cos(x[1])
    return jnp.stack([ring * jnp.cos(x[0]), ring * jnp.sin(x[0]), minor * jnp.sin(x[1])])


def bumpy_torus(x: Float[Array, " 2"]) -> Float[Array, " 3"]:
    """Return the point of the paper's bumpy torus (Table 1) with the radii 3 + ½cos 10x₁ and 1 + ⅕cos 8x₂.

    Examples:
        >>> np.allclose(hj.examples.bumpy_torus(jnp.zeros(2)), [3.5 + 1.2, 0.0, 0.0])
        True
    """
    return torus(x, 3 + jnp.cos(10 * x[0]) / 2, 1 + jnp.cos(8 * x[1]) / 5)


def torus_field(shape: Sequence[int], major: float = 2.0, minor: float = 1.0) -> TensorField:
    """Return the metric of a torus of revolution on its periodic chart (0, 2π)²; both axes are ``"periodic"``.

    The Gaussian curvature is cos x₂ / (minor (major + minor cos x₂)).

    Examples:
        >>> print(hj.examples.torus_field((9, 9)).tensors[0, 0].diagonal().round(3))  # of the outer equator
        [9. 1.]
    """
    return TensorField.from_function(pullback(partial(torus, major=major, minor=minor)), _periodic_grid(shape))


def bumpy_torus_field(n: int) -> TensorField:
    """Return the metric of the bumpy torus on n × n nodes; both axes are ``"periodic"``.

    Examples:
        >>> print(hj.examples.bumpy_torus_field(9).tensors[0, 0].diagonal().round(3))  # 4.7² and 1.2²
        [22.09  1.44]
    """
    return TensorField.from_function(pullback(bumpy_torus), _periodic_grid((n, n)))


def bumpy_torus_mesh(n: int) -> SurfaceMesh:
    """Return the bumpy torus as a surface of 2n² triangles; vertex i·n + j is node (i, j) of `bumpy_torus_field`.

    Examples:
        >>> mesh = hj.examples.bumpy_torus_mesh(9)
        >>> len(mesh.vertices) - len(mesh.triangulation.edges) + len(mesh.faces)  # Euler's characteristic
        0
    """
    nodes = jnp.asarray(_periodic_grid((n, n)).nodes).reshape(-1, 2)
    i, j = (axis.ravel() for axis in np.indices((n, n)))
    a, b, c, d = (((i + p) % n) * n + (j + q) % n for p, q in ((0, 0), (1, 0), (1, 1), (0, 1)))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return SurfaceMesh(jax.vmap(bumpy_torus)(nodes), faces)


def sphere_mesh(n: int) -> SurfaceMesh:
    """Return the unit sphere as a subdivided icosahedron with 20n² triangles and 10n² + 2 vertices.

    For n = 71 the mesh has 50 412 vertices. The eigenvalues of the sphere are l(l + 1) with the multiplicity 2l + 1.

    Examples:
        >>> mesh = hj.examples.sphere_mesh(3)
        >>> len(mesh.vertices) - len(mesh.triangulation.edges) + len(mesh.faces)  # Euler's characteristic
        2
    """
    require_count("n", n)
    return SurfaceMesh(*geodesic(n, 2))


def ball_mesh(n: int) -> TetMesh:
    """Return the unit ball as 20n³ tetrahedra in n layers about its centre, which is vertex 0.

    Layer j has the 10j² + 2 vertices of `sphere_mesh` on the sphere of radius j/n; for n = 24 the ball has 49 049
    vertices. Dihedral angles are between 36° and 130°.

    Let jₗ be the spherical Bessel functions. With Dirichlet conditions the eigenvalues of the ball are the squares of
    the positive zeros of jₗ; with Neumann conditions they are 0 and the squares of the positive zeros of jₗ'. Each
    eigenvalue has the multiplicity 2l + 1.

    Examples:
        >>> mesh = hj.examples.ball_mesh(2)
        >>> print(mesh.cells.shape, jnp.linalg.norm(mesh.vertices, axis=1).max().round(3))
        (160, 4) 1.0
    """
    require_count("n", n)
    return TetMesh(*geodesic(n, 3))


def _periodic_grid(shape: Sequence[int]) -> Grid:
    return Grid(shape, [2 * pi / n for n in shape])


def _stereographic(x: Float[Array, " 2"], sign: float) -> Float[Array, "2 2"]:
    return 4 / (1 + sign * x @ x) ** 2 * jnp.eye(2)


def sphere_field(n: int, half_width: float = 3.0) -> TensorField:
    """Return the unit sphere (K = 1) in its stereographic chart, with n × n nodes on (−half_width, half_width)².

    The sides' midpoints have the geodesic distance 2 arctan(half_width) from the centre. The opposite pole is missing.

    Examples:
        >>> print(hj.gaussian_curvature(hj.examples.sphere_field(9))[4, 4].round(3))
        1.0
    """
    grid = Grid.from_bounds(-half_width, half_width, (n, n))
    return TensorField.from_function(partial(_stereographic, sign=1.0), grid)


def hyperbolic_field(n: int, half_width: float = 0.6) -> TensorField:
    """Return the hyperbolic plane (K = −1) in the Poincaré disk, with n × n nodes on (−half_width, half_width)².

    Examples:
        >>> print(hj.gaussian_curvature(hj.examples.hyperbolic_field(9))[4, 4].round(3))
        -1.0
    """
    if not 0 < half_width < 0.5**0.5:
        raise ValueError(f"half_width: got {half_width}; expected between 0 and 1/√2, to fit into the disk")
    grid = Grid.from_bounds(-half_width, half_width, (n, n))
    return TensorField.from_function(partial(_stereographic, sign=-1.0), grid)


def _bump(squared: Array) -> Array:
    return 1 + 10 * jnp.exp(-squared)


def figure3_fields(n: int) -> dict[str, TensorField]:
    """Return the metrics T¹ … T⁴ of the paper's Fig. 3 on n × n nodes of (−5, 5)².

    For f(x) = 1 + 10 exp(−x²): T¹ = diag(f(u₁), 1) (flat), T² = diag(f(u₂), 1), T³ = diag(f(u₂), f(u₁)), T⁴ = f(|u|)·I.

    Examples:
        >>> print(hj.examples.figure3_fields(9)["T¹"].tensors[4, 4].diagonal())  # f(0) = 11
        [11.  1.]
    """

    def diagonal(entries: Callable[[Array, Array], Sequence[Array]]) -> Metric:
        return lambda u: jnp.diag(jnp.stack(entries(*jnp.square(u))))

    grid = Grid.from_bounds(-5, 5, (n, n))
    metrics = {
        "T¹": diagonal(lambda a, b: (_bump(a), jnp.ones_like(a))),
        "T²": diagonal(lambda a, b: (_bump(b), jnp.ones_like(a))),
        "T³": diagonal(lambda a, b: (_bump(b), _bump(a))),
        "T⁴": diagonal(lambda a, b: (_bump(a + b), _bump(a + b))),
    }
    return {name: TensorField.from_function(metric, grid) for name, metric in metrics.items()}


def rotated(angle: Callable[[Point], Array], major: float, minor: float) -> Metric:
    """Return a metric with constant eigenvalues; at the point u its major eigenvector has the ``angle(u)`` to axis 0.

    Examples:
        >>> metric = hj.examples.rotated(lambda u: jnp.pi / 2 + 0 * u[0], major=4.0, minor=1.0)
        >>> print(metric(jnp.zeros(2)).diagonal().round(3))
        [1. 4.]
    """

    def metric(u: Point) -> Float[Array, "2 2"]:
        c, s = jnp.cos(2 * angle(u)), jnp.sin(2 * angle(u))
        mean, half = (major + minor) / 2, (major - minor) / 2
        return mean * jnp.eye(2) + half * jnp.stack([jnp.stack([c, s]), jnp.stack([s, -c])])

    return metric


def figure4_fields(n: int, major: float = 4.0, minor: float = 1.0) -> dict[str, TensorField]:
    """Return fields with constant eigenvalues and analytic eigenvectors on n × n nodes of (0, 1)² (paper, Fig. 4).

    All fields have the same constant trace, determinant and anisotropy; only the eigenvectors differ. The centre of
    ``"circles"`` and ``"spirals"`` is (−0.3, −0.3), outside the square. The fields ``"straight"``, ``"circles"`` and
    ``"spirals"`` are flat; ``"waves"`` and ``"cells"`` are not.

    Examples:
        >>> waves = hj.examples.figure4_fields(9)["waves"]
        >>> print(np.linalg.eigvalsh(waves.tensors[2, 3]).round(3))
        [1. 4.]
    """

    def polar(u: Point) -> Array:
        return jnp.arctan2(u[1] + 0.3, u[0] + 0.3)

    angles: dict[str, Callable[[Point], Array]] = {
        "straight": lambda u: jnp.zeros_like(u[0]),
        "circles": lambda u: polar(u) + pi / 2,
        "spirals": lambda u: polar(u) + pi / 4,
        "waves": lambda u: jnp.arctan(jnp.cos(2 * pi * u[0])),
        "cells": lambda u: pi / 4 * jnp.sin(2 * pi * u[0]) * jnp.sin(2 * pi * u[1]),
    }
    grid = Grid.from_bounds(0, 1, (n, n))
    return {name: TensorField.from_function(rotated(angle, major, minor), grid) for name, angle in angles.items()}


def degenerate_point_field(index: float, n: int) -> TensorField:
    """Return a field with a degenerate point of the given index in the middle of n × n nodes of (−1, 1)² (Fig. 5).

    At the point u with the polar angle θ, the tensor is T = 10·I + 3|u| [[c, s], [s, −c]], where c and s are the cosine
    and the sine of 2·``index``·θ. The eigenvalues of T are 10 ± 3|u|. The major eigenvector has the angle ``index``·θ,
    where ``index`` is a multiple of ½. If the index is ½ or −½, the field is smooth at the centre. If the index is
    neither ½ nor −½, the field has no derivative at the centre, where the curvature is NaN.

    Examples:
        >>> hj.degenerate_points(hj.examples.degenerate_point_field(-0.5, 9)).indices
        array([-0.5])
    """
    m = round(abs(2 * index))
    if m == 0 or abs(m - abs(2 * index)) > 1e-12:
        raise ValueError(f"index: got {index}; expected a non-zero multiple of 1/2")

    def metric(u: Point) -> Float[Array, "2 2"]:
        x, y = u[0], u[1] if index > 0 else -u[1]
        length = jnp.ones_like(x)
        if m > 1:
            squared = u @ u
            length, safe = jnp.sqrt(squared), jnp.sqrt(jnp.where(squared > 0, squared, 1))
            x, y = x / safe, y / safe
        c, s = x, y  # the real and the imaginary part of a power of x + iy, so no angle is computed
        for _ in range(m - 1):
            c, s = x * c - y * s, x * s + y * c
        return 10 * jnp.eye(2) + 3 * length * jnp.stack([jnp.stack([c, s]), jnp.stack([s, -c])])

    return TensorField.from_function(metric, Grid.from_bounds(-1, 1, (n, n)))


GREY, WHITE, FLUID = 0.8e-3, (1.7e-3, 0.3e-3), 3.0e-3
"""Diffusivities in mm²/s of grey matter, of white matter along and across the fibres, and of cerebrospinal fluid."""

FIELD_OF_VIEW = (160.0, 190.0, 130.0)
"""The extents of the phantom in millimetres: left–right, back–front and down–up."""


def phantom(
    shape: Sequence[int] = (96, 112),
) -> tuple[Float[np.ndarray, "*shape d d"], Bool[np.ndarray, "*shape"], tuple[float, ...]]:
    """Return diffusion tensors of a phantom that resembles an axial slice of a brain, or a stack of such slices.

    The phantom has a folded cortex of grey matter, and two ventricles. The white matter has a corpus callosum, an arc
    of fibres on each side, and crossings of callosum and arcs.

    Args:
        shape: the number of voxels along 2 axes (left–right, back–front) or 3 axes (left–right, back–front, down–up).

    Returns:
        The tensors (*shape, d, d) in mm²/s, SPD everywhere; the mask (*shape); the spacing per axis in mm.

    Examples:
        >>> tensors, mask, spacing = hj.examples.phantom((24, 28))
        >>> print(tensors.shape, np.linalg.eigvalsh(tensors).min() > 0)
        (24, 28, 2, 2) True
    """
    d = len(shape)
    if d not in (2, 3):
        raise ValueError(f"shape: got {tuple(shape)}; expected 2 or 3 axes")
    axes = [np.linspace(-1, 1, n) for n in shape]
    x, y, *third = np.meshgrid(*axes, indexing="ij")
    z = third[0] if third else np.zeros_like(x)
    # Slices of an ellipsoid become smaller towards its ends.
    shrink = np.sqrt(np.clip(1 - 0.8 * z**2, 0.1, None))
    x, y = x / shrink, y / shrink

    radius, angle = np.hypot(x / 0.86, y / 0.9), np.arctan2(y, x)
    mask = radius < 1
    folds = 0.84 + 0.045 * np.sin(14 * angle) + 0.03 * np.sin(9 * angle + 1)
    fissure = _ridge(x, 0.03) * _step(np.abs(y) - 0.42, 0.05)
    white = _step(folds - radius, 0.035) * (1 - fissure)
    deep = _blob(np.abs(x) - 0.27, y + 0.1, 0.1, 0.17)  # grey nuclei beside the ventricles
    white *= 1 - deep
    ventricles = _blob(np.abs(x) - 0.12 - 0.1 * y**2, y - 0.05, 0.055, 0.3)

    # Fibre directions are averaged as weighted dyads, so that their signs do not matter.
    callosum = sum(_ridge(np.hypot(x / 0.62, (y - end) / 0.3) - 1, 0.14) * _step(side * (y - end), 0.05)
                   for end, side in ((0.38, -1), (-0.32, 1)))  # fmt: skip
    middle = _blob(x, y - 0.38 + 0.28, 0.3, 0.08) + _blob(x, y + 0.32 - 0.28, 0.3, 0.08)
    arcs = _ridge(np.hypot(x / 0.6, y / 0.72) - 1, 0.12)
    radial = np.arctan2(y / 0.81, x / 0.74)
    bundles = [
        (callosum + middle, np.arctan2(-0.9 * x * np.sign(y), 0.35)),
        (1.5 * arcs, radial + np.pi / 2),
        (0.25 * np.ones_like(x), radial),
    ]
    total = sum(weight for weight, _ in bundles)
    tensors = GREY * np.broadcast_to(np.eye(d), (*x.shape, d, d))
    fibres = np.zeros_like(tensors)
    for weight, direction in bundles:
        v = np.stack([np.cos(direction), np.sin(direction), 0 * direction][:d], axis=-1)
        dyad = WHITE[1] * np.eye(d) + (WHITE[0] - WHITE[1]) * v[..., :, None] * v[..., None, :]
        fibres += (weight / total)[..., None, None] * dyad
    tensors = _mix(tensors, fibres, white)
    tensors = _mix(tensors, FLUID * np.eye(d), np.clip(ventricles + 0.5 * fissure, 0, 1))
    return tensors, mask, tuple(extent / (n - 1) for extent, n in zip(FIELD_OF_VIEW, shape, strict=False))


def _step(x: np.ndarray, width: float) -> np.ndarray:
    return 0.5 * (1 + np.tanh(x / width))


def _ridge(x: np.ndarray, width: float) -> np.ndarray:
    return np.exp(-((x / width) ** 2))


def _blob(x: np.ndarray, y: np.ndarray, a: float, b: float) -> np.ndarray:
    return _step(1 - np.hypot(x / a, y / b), 0.15)


def _mix(a: np.ndarray, b: np.ndarray, weight: np.ndarray) -> np.ndarray:
    return a + weight[..., None, None] * (b - a)
