"""The noise of measured tensors: its covariance at every node, and how far neighbours share it."""

import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.special import gammaincinv

from hks_jax.checks import real_array, require_number
from hks_jax.domain.grid import Grid
from hks_jax.traced import is_traced
from hks_jax.uncertainty.smoothing import along_axes, gaussians

_ROUNDING = 1e-6
"""What a covariance's least eigenvalue may be below zero, relative to the largest."""
_NORMAL = 1.4826
"""The standard deviation of a normal variable over the median of its modulus."""


class TensorNoise(eqx.Module):
    """Normal noise of symmetric tensors at nodes, or at the cells of a mesh.

    The components of a tensor follow each other as in NIfTI and DIPY: xx xy yy (in 2D), xx xy yy xz yz zz (in 3D).

    Attributes:
        covariance: (*shape, m, m) of the m = d(d+1)/2 components, along the axes of the tensors and in their squared
            unit; positive semidefinite.
        grid: of the nodes; None where they lie on no grid, as on a mesh.
        correlation: how far neighbours share their noise, in coordinate units: white noise blurred by a Gaussian of
            this standard deviation, and scaled to the covariance. Nodes a distance r apart then have the correlation
            exp(−r²/4w²). 0: independent.
        modes: (*shape, n, m), the fields of which the noise is the sum (see `from_modes`), or None.
        freedom: the degrees of freedom with which the covariance is known; infinite for a stated one.

    Raises:
        ValueError: a covariance that is not positive semidefinite (at how many nodes, where, and by how much), or of
            another shape; a correlation without a grid.
    """

    covariance: Float[Array, "*shape m m"]
    grid: Grid | None = eqx.field(static=True)
    correlation: float = eqx.field(static=True)
    modes: Float[Array, "*shape n m"] | None
    freedom: float = eqx.field(static=True)

    def __init__(
        self,
        covariance: Any,
        grid: Grid | None = None,
        correlation: float = 0.0,
        *,
        modes: Any = None,
        freedom: float = math.inf,
    ) -> None:
        self.covariance = real_array("covariance", covariance)
        self.modes, self.freedom = modes, freedom
        self.grid = grid
        require_number("correlation", correlation, inclusive=True)
        self.correlation = float(correlation)
        shape = self.covariance.shape
        if len(shape) < 3 or shape[-1] != shape[-2] or shape[-1] not in (3, 6):
            raise ValueError(
                f"covariance: got shape {shape}; expected (*shape, m, m), m = 3 for tensors of the plane (xx xy yy) "
                "and 6 for those of space (xx xy yy xz yz zz)"
            )
        if grid is not None and shape[:-2] != grid.shape:
            raise ValueError(f"covariance: got shape {shape}; expected (*grid.shape, m, m), grid.shape = {grid.shape}")
        if correlation and grid is None:
            raise ValueError("correlation: got a length but no grid; give the grid whose nodes share their noise")
        if not is_traced(self.covariance):
            _check_semidefinite(np.asarray(self.covariance))

    @classmethod
    def from_modes(cls, modes: Any, grid: Grid | None = None, unknowns: int = 0) -> "TensorNoise":
        """Return noise that is the sum of n fields, each times a standard normal number of its own.

        The fields of a scan are what each of its images changes of the tensors by its residuals
        (`hks_jax.io.TensorVolume.modes`): random signs of whole images, a wild bootstrap. Voxels share this noise just
        as they share residuals: by the reconstruction, by drift of the scanner or motion between images, and by
        diffusion that no tensor describes.

        Args:
            modes: (*shape, n, m) of the m components, along the axes of the tensors and in their unit.
            grid: see `TensorNoise`.
            unknowns: of the fit: n less as many are the degrees of freedom that intervals take account of.
        """
        values = real_array("modes", modes)
        if values.ndim < 3 or values.shape[-2] <= unknowns:
            raise ValueError(f"modes: got shape {values.shape}; expected (*shape, n, m), n > unknowns = {unknowns}")
        covariance = jnp.einsum("...na,...nb->...ab", values, values, precision="highest")
        return cls(covariance, grid, modes=values, freedom=values.shape[-2] - unknowns)

    @classmethod
    def relative(cls, tensors: Any, level: float, grid: Grid | None = None, correlation: float = 0.0) -> "TensorNoise":
        """Return noise of a stated level: the deviation of a diagonal component over the mean diffusivity tr D/d.

        It is the same in all directions: what is off the diagonal has a deviation smaller by √2.

        Args:
            tensors: (*shape, d, d) as measured.
            level: such as 0.1 for 10 %.
            grid: see `TensorNoise`.
            correlation: see `TensorNoise`.
        """
        require_number("level", level, inclusive=True)
        values = real_array("tensors", tensors)
        return cls(_isotropic(values.shape[-1], level**2) * _squared_mean(values), grid, correlation)

    @classmethod
    def from_scans(cls, first: Any, second: Any, grid: Grid) -> "TensorNoise":
        """Estimate the noise of each of two scans of the same subject: half of the square of their difference.

        One covariance, relative to the squared mean diffusivity, and one correlation length are estimated over all
        nodes inside the mask: the size of the former by a median, the latter from neighbours along the axes. Assumed
        are scans that lie exactly on each other, and equal and independent noise: whatever moved between them counts
        as noise.

        Args:
            first: (*shape, d, d), tensors of one scan.
            second: likewise, of the other.
            grid: of both.

        Returns:
            The noise of one scan; of the mean of both it is half, ``TensorNoise(noise.covariance / 2, …)``.

        Raises:
            ValueError: tensors of different shapes, or that are the same.
        """
        a, b = np.asarray(first, np.float64), np.asarray(second, np.float64)
        expected = (*grid.shape, grid.dimension, grid.dimension)
        if not a.shape == b.shape == expected:
            raise ValueError(f"first, second: got shapes {a.shape} and {b.shape}; expected {expected} of both")
        inside = grid.inside
        scale = np.trace(a + b, axis1=-2, axis2=-1) / (2 * grid.dimension)
        parts = _components(a - b) / np.where(inside, scale, 1.0)[..., None]
        relative = np.einsum("na,nb->ab", parts[inside], parts[inside]) / (2 * inside.sum())
        if not np.trace(relative) > 0:
            raise ValueError("first, second: they are the same; expected two scans, whose noise differs")
        # The typical node counts, not the few, as in fluid, that have much more noise: q would have χ²'s median.
        q = np.einsum("na,ab,nb->n", parts[inside], np.linalg.pinv(2 * relative), parts[inside])
        relative *= np.median(q) / (2 * gammaincinv(len(relative) / 2, 0.5))
        # Blurred white noise has the correlation exp(−h²/4w²) at the distance h.
        widths = []
        for axis, h in enumerate(grid.spacing):
            x, y = (np.moveaxis(inside, axis, 0)[part] for part in (slice(1, None), slice(None, -1)))
            u, v = (np.moveaxis(parts, axis, 0)[part][x & y] for part in (slice(1, None), slice(None, -1)))
            shared = float(np.sum(u * v) / np.sqrt(np.sum(u * u) * np.sum(v * v))) if u.size else 0.0
            widths.append(h / (2 * math.sqrt(-math.log(min(shared, 0.99)))) if shared > 0.05 else 0.0)
        return cls(relative * np.asarray(_squared_mean((a + b) / 2)), grid, float(np.mean(widths)))

    @classmethod
    def from_roughness(cls, tensors: Any, grid: Grid) -> "TensorNoise":
        """Estimate a level of noise from how much the tensors themselves vary from node to node.

        A node less the mean of its two neighbours along an axis is noise where the field is smooth, and √1.5 times
        its deviation. The median over all nodes and axes ignores edges, as long as they are few. Assumed is noise that
        neighbours do not share: after smoothing or interpolation the estimate is too small, in fine anatomy too large.

        Args:
            tensors: (*shape, d, d) as measured.
            grid: of the nodes.

        Raises:
            ValueError: tensors that do not fit the grid, or that do not vary.
        """
        values, d = np.asarray(tensors, np.float64), grid.dimension
        if values.shape != (*grid.shape, d, d):
            raise ValueError(f"tensors: got shape {values.shape}; expected {(*grid.shape, d, d)}")
        scale = np.where(grid.inside, np.trace(values, axis1=-2, axis2=-1) / d, 1.0)
        found = []
        for axis in range(d):
            part = np.moveaxis(np.diagonal(values, axis1=-2, axis2=-1), axis, 0)
            inside, mean = np.moveaxis(grid.inside, axis, 0), np.moveaxis(scale, axis, 0)
            three = inside[2:] & inside[1:-1] & inside[:-2]
            middle = (part[1:-1] - (part[2:] + part[:-2]) / 2) / mean[1:-1, ..., None]
            found.append(np.abs(middle[three]).ravel())
        level = _NORMAL * float(np.median(np.concatenate(found))) / math.sqrt(1.5) if np.concatenate(found).size else 0
        if not level > 0:
            raise ValueError("tensors: they do not vary from node to node; state a level by `TensorNoise.relative`")
        return cls.relative(values, level, grid)

    def __repr__(self) -> str:
        """Return one line."""
        shared = f", neighbours share it over {self.correlation:.3g}" if self.correlation else ""
        return f"TensorNoise({self.covariance.shape[-1]} components at {self.covariance.shape[:-2]}{shared})"

    @property
    def dimension(self) -> int:
        """The number of rows d of a tensor."""
        return 2 if self.covariance.shape[-1] == 3 else 3

    @property
    def white_shape(self) -> tuple[int, ...]:
        """The shape of the numbers of which `tensors` makes noise: (*shape, m), or (n,) of modes."""
        return self.covariance.shape[:-1] if self.modes is None else self.modes.shape[-2:-1]

    def tensors(self, white: Float[Array, "..."]) -> Float[Array, "*shape d d"]:
        """Return the noise that independent standard normal numbers make: linear in them, of this covariance."""
        if self.correlation:
            assert self.grid is not None
            kernels = [jnp.asarray(each, white.dtype) for each in gaussians(self.grid, self.correlation)]
            white = along_axes(kernels, white)
        if self.modes is None:
            root = _root(self.covariance).astype(white.dtype)
            parts = jnp.einsum("...ab,...b->...a", root, white, precision="highest")
        else:
            parts = jnp.einsum("...na,n->...a", self.modes.astype(white.dtype), white, precision="highest")
        which = np.zeros((self.dimension, self.dimension), int)
        which[np.tril_indices(self.dimension)] = np.arange(parts.shape[-1])
        return parts[..., np.maximum(which, which.T)]


def _components(tensors: Float[np.ndarray, "*shape d d"]) -> Float[np.ndarray, "*shape m"]:
    rows, columns = np.tril_indices(tensors.shape[-1])
    return tensors[..., rows, columns]


def _isotropic(d: int, variance: float) -> Float[np.ndarray, "m m"]:
    rows, columns = np.tril_indices(d)
    return np.diag(np.where(rows == columns, variance, variance / 2))


def _squared_mean(tensors: Any) -> Float[Array, "*shape 1 1"]:
    return jnp.square(jnp.trace(jnp.asarray(tensors), axis1=-2, axis2=-1) / np.shape(tensors)[-1])[..., None, None]


def _root(covariance: Float[Array, "*shape m m"]) -> Float[Array, "*shape m m"]:
    """Return the Cholesky factor; where a pivot is zero, as that of a singular covariance, so is its column."""
    factor = jnp.zeros_like(covariance)
    least = 1e-12 * jnp.max(jnp.diagonal(covariance, axis1=-2, axis2=-1), axis=-1)
    for j in range(covariance.shape[-1]):
        column = covariance[..., j] - jnp.sum(factor * factor[..., j, None, :], axis=-1)
        positive = (column[..., j] > least)[..., None]
        column = column / jnp.sqrt(jnp.where(positive, column[..., j, None], 1))
        factor = factor.at[..., j:, j].set(jnp.where(positive, column, 0)[..., j:])
    return factor


def _check_semidefinite(covariance: Float[np.ndarray, "*shape m m"]) -> None:
    if not np.isfinite(covariance).all():
        bad = ~np.isfinite(covariance).all(axis=(-2, -1))
        raise ValueError(
            f"covariance: NaN or infinite at {int(bad.sum())} of {bad.size} nodes, the first at "
            f"{tuple(int(i) for i in np.argwhere(bad)[0])}; expected finite numbers, zeros where there is no noise"
        )
    size = np.abs(covariance).max(axis=(-2, -1))
    apart = np.abs(covariance - np.swapaxes(covariance, -1, -2)).max(axis=(-2, -1))
    least = np.linalg.eigvalsh(covariance)[..., 0]
    bad = (apart > _ROUNDING * size) | (least < -_ROUNDING * size)
    if bad.any():
        worst = tuple(int(i) for i in np.unravel_index(np.argmin(np.where(bad, least, np.inf)), bad.shape))
        raise ValueError(
            f"covariance: not symmetric positive semidefinite at {int(bad.sum())} of {bad.size} nodes, the worst at "
            f"{worst}, of eigenvalues from {least[worst]:.3g} and entries up to {size[worst]:.3g}; expected (m, m) "
            "covariances of the components xx xy yy (xz yz zz), not standard deviations or correlations of pairs"
        )
