"""The noise of measured tensors: its covariance at every node, and its correlation between nodes."""

import math
from functools import partial
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float

from hks_jax.checks import real_array, require_number
from hks_jax.domain import spd
from hks_jax.domain.grid import Grid
from hks_jax.domain.tensor_checks import tensors_on
from hks_jax.traced import is_traced
from hks_jax.uncertainty.smoothing import along_axes, gaussians

_ROUNDING = 1e-6
"""The tolerance for asymmetry and negative eigenvalues of a covariance, relative to its largest entry."""
_NORMAL = 1.4826
"""The ratio of the standard deviation of a normal variable with mean zero to the median of its absolute value."""


class TensorNoise(eqx.Module):
    """Normally distributed noise of symmetric tensors at the nodes of a grid or the cells of a mesh.

    The components of a tensor have the order of NIfTI and DIPY: xx xy yy in 2D, xx xy yy xz yz zz in 3D.

    Attributes:
        covariance: (*shape, m, m), the covariance of the m = d(d+1)/2 components, along the axes of the tensors and in
            their squared unit; positive semidefinite.
        grid: the grid of the nodes; None if the tensors are not on a grid, as on a mesh.
        correlation: the correlation length w of the noise in coordinate units. The noise is white noise, smoothed by a
            Gaussian with the standard deviation w, and scaled to the covariance. The noise of two nodes at a distance r
            has the correlation exp(−r²/4w²). If w is 0, the noise is independent between nodes.
        modes: (*shape, n, m), the n fields whose sum with random factors is the noise (see `from_modes`), or None.
        freedom: the degrees of freedom of the covariance if it was estimated; infinite if it was given.

    Raises:
        ValueError: The covariance is not positive semidefinite, or has another shape; a correlation has no grid.

    Examples:
        >>> noise = hj.TensorNoise(np.tile(np.eye(3), (9, 9, 1, 1)))
        >>> print(noise.tensors(jnp.ones((9, 9, 3)))[4, 4].tolist())  # one deviation of xx, xy and yy
        [[1.0, 1.0], [1.0, 1.0]]
    """

    covariance: Float[Array | np.ndarray, "*shape m m"] = eqx.field(converter=partial(real_array, "covariance"))
    grid: Grid | None = eqx.field(static=True, default=None)
    correlation: float = eqx.field(static=True, default=0.0)
    modes: Float[Array, "*shape n m"] | None = eqx.field(default=None, kw_only=True)
    freedom: float = eqx.field(static=True, default=math.inf, kw_only=True)

    def __check_init__(self) -> None:
        grid = self.grid
        require_number("correlation", self.correlation, inclusive=True)
        if not self.freedom > 0:
            raise ValueError(f"freedom: got {self.freedom}; expected a positive number of degrees of freedom")
        shape = self.covariance.shape
        if len(shape) < 3 or shape[-1] != shape[-2] or shape[-1] not in (3, 6):
            raise ValueError(
                f"covariance: got shape {shape}; expected (*shape, m, m), where m is 3 for tensors in 2D (xx xy yy) "
                "and 6 for tensors in 3D (xx xy yy xz yz zz)"
            )
        if grid is not None and shape[:-2] != grid.shape:
            raise ValueError(f"covariance: got shape {shape}; expected {(*grid.shape, *shape[-2:])} for this grid")
        if self.correlation and grid is None:
            raise ValueError("correlation: got a length but no grid; expected both. Pass the grid of the tensors")
        if self.correlation and self.modes is not None:
            raise ValueError("correlation: got a length beside modes, which have a correlation. Leave one of them out")
        if not is_traced(self.covariance):
            _check_semidefinite(np.asarray(self.covariance))

    @classmethod
    def from_modes(cls, modes: Any, grid: Grid | None = None, unknowns: int = 0) -> "TensorNoise":
        """Return noise Σᵢ zᵢ mᵢ, where mᵢ are n given fields and zᵢ are independent standard normal numbers.

        For a scan, the field mᵢ is the change of the tensors that the residuals of image i cause
        (`hks_jax.io.TensorVolume.modes`). Multiplying the residuals of each image by one random number zᵢ is called a
        wild bootstrap. The noise Σᵢ zᵢ mᵢ is correlated between voxels like the residuals, because of the image
        reconstruction, drift of the scanner, motion between images, and diffusion that no tensor describes.

        Args:
            modes: (*shape, n, m), the m components of the n fields, along the axes of the tensors and in their unit.
            grid: see `TensorNoise`.
            unknowns: the number of unknowns of the fit; intervals use n − unknowns degrees of freedom.
        """
        values = real_array("modes", modes)
        if values.ndim < 3 or values.shape[-2] <= unknowns:
            raise ValueError(f"modes: got shape {values.shape}; expected (*shape, n, m) with n > unknowns = {unknowns}")
        covariance = jnp.einsum("...na,...nb->...ab", values, values, precision="highest")
        return cls(covariance, grid, modes=values, freedom=values.shape[-2] - unknowns)

    @classmethod
    def relative(cls, tensors: Any, level: float, grid: Grid | None = None, correlation: float = 0.0) -> "TensorNoise":
        """Return noise with a given ratio of a diagonal component's standard deviation to the mean diffusivity.

        The noise is isotropic: the standard deviation of an off-diagonal component is smaller by the factor √2.

        Args:
            tensors: (*shape, d, d), the measured tensors.
            level: the ratio of the standard deviation to the mean diffusivity, for example 0.1 for 10 %.
            grid: see `TensorNoise`.
            correlation: see `TensorNoise`.

        Examples:
            >>> noise = hj.TensorNoise.relative(field.tensors, 0.1)  # of tensors with the trace 5
            >>> print(jnp.sqrt(noise.covariance[4, 4].diagonal()).round(3))
            [0.25  0.177 0.25 ]
        """
        require_number("level", level, inclusive=True)
        values = real_array("tensors", tensors)
        rows, columns = np.tril_indices(values.shape[-1])
        isotropic = np.diag(np.where(rows == columns, level**2, level**2 / 2))
        return cls(_scaled(isotropic, values, grid), grid, correlation)

    @classmethod
    def from_scans(cls, first: Any, second: Any, grid: Grid) -> "TensorNoise":
        """Estimate the noise of one scan as half of the mean squared difference of two scans of the same subject.

        The function uses all nodes inside the mask to estimate a covariance relative to the squared mean diffusivity,
        and a correlation length. The size of the covariance follows from the median of the squared differences over the
        nodes, and the correlation length from the correlation of differences at neighbouring nodes. The scans must be
        aligned, and their noise must be independent and have the same covariance. The estimate includes the effect of
        motion between the scans. The mean of both scans has half of the estimated covariance.

        Args:
            first: (*shape, d, d), the tensors of the first scan.
            second: (*shape, d, d), the tensors of the second scan.
            grid: the grid of both scans.

        Raises:
            ValueError: The tensors do not have the shape of the grid, or both scans are equal.
        """
        a, b = (
            np.asarray(tensors_on(grid, name, scan), np.float64)
            for name, scan in (("first", first), ("second", second))
        )
        inside = grid.inside
        scale = np.trace(a + b, axis1=-2, axis2=-1) / (2 * grid.dimension)
        parts = (a - b)[..., *np.tril_indices(grid.dimension)] / np.where(inside, scale, 1.0)[..., None]
        relative = np.einsum("na,nb->ab", parts[inside], parts[inside]) / (2 * inside.sum())
        if not np.trace(relative) > 0:
            raise ValueError("first, second: got equal tensors; expected different noise. Pass a second scan")
        # The covariance is scaled so that the median of q is the median of χ²: a few nodes, as in fluid, are noisier.
        q = np.einsum("na,ab,nb->n", parts[inside], np.linalg.pinv(2 * relative), parts[inside])
        relative *= np.median(q) / (2 * scipy.special.gammaincinv(len(relative) / 2, 0.5))
        # White noise, smoothed with the width w, has the correlation exp(−h²/4w²) at the distance h.
        widths = []
        for axis, h in enumerate(grid.spacing):
            x, y = (np.moveaxis(inside, axis, 0)[part] for part in (slice(1, None), slice(None, -1)))
            u, v = (np.moveaxis(parts, axis, 0)[part][x & y] for part in (slice(1, None), slice(None, -1)))
            shared = float(np.sum(u * v) / np.sqrt(np.sum(u * u) * np.sum(v * v))) if u.size else 0.0
            widths.append(h / (2 * math.sqrt(-math.log(min(shared, 0.99)))) if shared > 0.05 else 0.0)
        return cls(_scaled(relative, (a + b) / 2, grid), grid, float(np.mean(widths)))

    @classmethod
    def from_roughness(cls, tensors: Any, grid: Grid) -> "TensorNoise":
        """Estimate the level of noise from second differences of the tensors.

        In a smooth field, the tensor at a node minus the mean of its two neighbours along an axis is only noise, with
        √1.5 times the standard deviation of the noise at one node. The median of these differences over all nodes and
        axes hardly depends on the few nodes at edges of the anatomy. The noise must be independent between nodes. The
        estimate is too small after smoothing or interpolation, and too large in fine anatomy.

        Args:
            tensors: (*shape, d, d), the measured tensors.
            grid: the grid of the nodes.

        Raises:
            ValueError: The tensors do not have the shape of the grid, or most of their second differences are zero.
        """
        values, d = np.asarray(tensors_on(grid, "tensors", tensors), np.float64), grid.dimension
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
            raise ValueError("tensors: got no noise at the majority of nodes; give a level to `TensorNoise.relative`")
        return cls.relative(values, level, grid)

    def __repr__(self) -> str:
        shared = f", correlation length {self.correlation:.3g}" if self.correlation else ""
        return f"TensorNoise({self.covariance.shape[-1]} components at {self.covariance.shape[:-2]}{shared})"

    @property
    def dimension(self) -> int:
        """The number of rows d of a tensor."""
        return 2 if self.covariance.shape[-1] == 3 else 3

    @property
    def white_shape(self) -> tuple[int, ...]:
        """The shape of the argument of `tensors`: (*shape, m), or (n,) if the noise has n modes."""
        return self.covariance.shape[:-1] if self.modes is None else self.modes.shape[-2:-1]

    def tensors(self, white: Float[Array, "..."]) -> Float[Array, "*shape d d"]:
        """Map independent standard normal numbers linearly to noise with this covariance."""
        if self.correlation:
            assert self.grid is not None
            kernels = [jnp.asarray(each, white.dtype) for each in gaussians(self.grid, self.correlation)]
            white = along_axes(kernels, white)
        if self.modes is None:
            root = spd.cholesky(jnp.asarray(self.covariance), negligible=1e-12).astype(white.dtype)
            parts = jnp.einsum("...ab,...b->...a", root, white, precision="highest")
        else:
            parts = jnp.einsum("...na,n->...a", self.modes.astype(white.dtype), white, precision="highest")
        which = np.zeros((self.dimension, self.dimension), int)
        which[np.tril_indices(self.dimension)] = np.arange(parts.shape[-1])
        return parts[..., np.maximum(which, which.T)]


def _scaled(relative: Float[np.ndarray, "m m"], tensors: Any, grid: Grid | None) -> Float[Array, "*shape m m"]:
    """Return a covariance relative to the squared mean eigenvalue of the tensors (*shape, d, d) in absolute units.

    The covariance is 0 outside the grid's mask, where tensors may be NaN.
    """
    squared = jnp.square(jnp.trace(jnp.asarray(tensors), axis1=-2, axis2=-1) / np.shape(tensors)[-1])
    if grid is not None and grid.shape == squared.shape:
        squared = jnp.where(grid.inside, squared, 0)
    return jnp.multiply.outer(squared, jnp.asarray(relative, squared.dtype))


def _check_semidefinite(covariance: Float[np.ndarray, "*shape m m"]) -> None:
    finite = np.isfinite(covariance).all(axis=(-2, -1))
    known = np.where(finite[..., None, None], covariance, 0)
    size = np.abs(known).max(axis=(-2, -1))
    apart = np.abs(known - np.swapaxes(known, -1, -2)).max(axis=(-2, -1))
    least = np.where(finite, np.linalg.eigvalsh(known)[..., 0], -np.inf)
    bad = ~finite | (apart > _ROUNDING * size) | (least < -_ROUNDING * size)
    if bad.any():
        worst = tuple(int(i) for i in np.unravel_index(np.argmin(np.where(bad, least, np.inf)), bad.shape))
        raise ValueError(
            f"covariance: got matrices that are not finite, symmetric and positive semidefinite at {int(bad.sum())} of "
            f"{bad.size} nodes, the worst at {worst} with least eigenvalue {least[worst]:.3g}, entries up to "
            f"{size[worst]:.3g}; expected (m, m) covariances of the components xx xy yy (xz yz zz), 0 at nodes without "
            "noise. Do not pass standard deviations"
        )
