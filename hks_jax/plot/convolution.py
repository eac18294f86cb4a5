"""Line integral convolution: noise smeared along the eigenvector field, which shows every direction at once."""

from typing import Any

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Bool, Complex, Float, Real
from matplotlib.axes import Axes
from matplotlib.image import AxesImage
from scipy.special import ndtr

from hks_jax.domain.components import active_elements
from hks_jax.domain.tensor_field import TensorField
from hks_jax.plot.figure import frame, require_plane, side_in_inches
from hks_jax.plot.images import scalar_image
from hks_jax.plot.tracing import LEAST_COSINE, DirectionField, Which

PIXELS_PER_INCH = 110
"""Grains of about this size are seen, and not lost, in print and on screens."""

FRAME = 3
"""Pixels: more than a step can go."""


def lic_texture(
    field: TensorField, which: Which = "major", *, pixels: int = 400, length: int = 25, seed: int = 0
) -> Float[np.ndarray, "px py"]:
    """Return white noise averaged along the integral lines of an eigenvector field (Cabral and Leedom 1993).

    An eigenvector has no sign: each step takes the one that goes on. The average is weighted by a bell; divided by the
    deviation that it would have, and taken through the normal distribution, it is uniform in (0, 1) whatever the number
    of pixels in it: contrast does not fade or grow where lines end, at degenerate points, sides and rims.

    Args:
        field: a 2D field.
        which: ``"major"``, the eigenvector of the larger eigenvalue of T, or ``"minor"``.
        pixels: how many along the longer side of the grid.
        length: of the smear to either side, in pixels.
        seed: of the noise.

    Returns:
        (px, py) over the rectangle of the nodes, `field.grid.extent`, array axis 0 horizontal; NaN in cells that are
        not inside the mask. Where eigenvalues are equal the noise is as it was.

    Raises:
        ValueError: a 3D field; an unknown `which`; fewer than 2 pixels; a length below 1.
    """
    direction = DirectionField(field, which)
    if pixels < 2 or length < 1:
        raise ValueError(f"pixels, length: got {pixels}, {length}; expected at least 2 pixels and a length from 1")
    x0, x1, y0, y1 = field.grid.extent
    side = max(x1 - x0, y1 - y0) / pixels
    shape = (max(2, round((x1 - x0) / side)), max(2, round((y1 - y0) / side)))
    size = np.array([(x1 - x0) / shape[0], (y1 - y0) / shape[1]])
    centres = np.moveaxis(np.indices(shape), 0, -1).reshape(-1, 2) + 0.5
    points = [x0, y0] + centres * size
    noise = np.random.default_rng(seed).standard_normal(shape).astype(np.float32)
    # In steps of a pixel it is enough to know the direction at every pixel. Complex numbers are vectors here, and the
    # frame of NaN stops what leaves the picture: there are no conditions to check, which would take most of the time.
    along = _complex(direction(points) / size * side).reshape(shape)
    along, values = np.pad(along, FRAME, constant_values=np.nan), np.pad(noise, FRAME)
    total, squares = noise.ravel().copy(), np.ones(noise.size, np.float32)
    bell = np.cos(np.pi / 2 * np.arange(1, length + 1) / (length + 1)) ** 2
    start = _complex(centres + FRAME)
    for sign in (1, -1):
        heading = sign * along[_pixel(start)]
        alive = np.flatnonzero(np.isfinite(heading))
        position, heading = start[alive], heading[alive]
        for weight in bell.astype(np.float32):
            # The midpoint rule: Euler's would spiral out of circles.
            middle, onwards = _onwards(along, position + 0.5 * heading, heading)
            position = position + np.where(onwards, middle, heading)
            heading, onwards = _onwards(along, position, heading)
            alive, position, heading = alive[onwards], position[onwards], heading[onwards]
            total[alive] += weight * values[_pixel(position)]
            squares[alive] += weight**2
    cell = np.clip(np.floor(centres * size / field.grid.spacing).astype(int), 0, np.array(field.grid.shape) - 2)
    inside = active_elements(field.grid.inside, (False, False))[tuple(cell.T)]
    return np.where(inside, ndtr(total / np.sqrt(squares)), np.nan).reshape(shape)


def line_integral_convolution(
    ax: Axes,
    field: TensorField,
    which: Which = "major",
    *,
    values: Real[ArrayLike, "nx ny"] | None = None,
    contrast: float = 0.75,
    pixels: int | None = None,
    length: int = 25,
    seed: int = 0,
    **kwargs: Any,
) -> AxesImage:
    """Shade an image by the line integral convolution of an eigenvector field.

    The texture darkens and lightens the colours below it equally, so that on average they are those of the colour bar.

    Args:
        ax: the axes to draw on.
        field: a 2D field.
        which: ``"major"`` or ``"minor"``.
        values: (*shape,) a scalar such as the HKS, drawn by `scalar_image`; None: what `ax` shows already, or grey.
        contrast: how far the colours go to black and white, in (0, 1].
        pixels: of the texture along the longer side; None: about 110 an inch of the axes, so that the grain has one
            size on paper.
        length: as for `lic_texture`.
        seed: of the noise.
        **kwargs: passed to `scalar_image`, for `values`.

    Returns:
        The texture's image.

    Raises:
        ValueError: a 3D field; options that do not exist or are out of range.
    """
    require_plane("field", field.grid)
    if not 0 < contrast <= 1:
        raise ValueError(f"contrast: got {contrast}; expected a number in (0, 1]")
    x0, x1, y0, y1 = field.grid.extent
    if pixels is None:
        pixels = int(np.clip(PIXELS_PER_INCH * side_in_inches(ax, (x1 - x0, y1 - y0)), 100, 1200))
    texture = lic_texture(field, which, pixels=pixels, length=length, seed=seed)
    if values is not None:
        scalar_image(ax, values, field.grid, **{"interpolation": "bilinear", **kwargs})
    shift = contrast * (2 * texture.T - 1)
    shade = np.zeros((*shift.shape, 4))
    if ax.images:
        # Black at opacity p multiplies a colour by 1 − p; white at opacity p brings it as much nearer to white.
        shade[..., :3] = (shift > 0)[..., None]
        shade[..., 3] = np.abs(shift)
    else:
        shade[..., :3] = (0.5 + shift / 2)[..., None]
        shade[..., 3] = 1
    shade[np.isnan(shift)] = 0
    image = ax.imshow(shade, origin="lower", extent=(x0, x1, y0, y1), interpolation="nearest")
    frame(ax, field.grid)
    return image


def _complex(vectors: Float[np.ndarray, "n 2"]) -> Complex[np.ndarray, " n"]:
    return np.ascontiguousarray(vectors, np.float32).view(np.complex64)[:, 0]


def _pixel(position: Complex[np.ndarray, " n"]) -> tuple[np.ndarray, np.ndarray]:
    return position.real.astype(np.int32), position.imag.astype(np.int32)


def _onwards(
    along: Complex[np.ndarray, "px py"], position: Complex[np.ndarray, " n"], heading: Complex[np.ndarray, " n"]
) -> tuple[Complex[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Return the direction at each position with the sign that goes on, and where it does go on."""
    there = along[_pixel(position)]
    product = (there * heading.conj()).real
    straight = np.abs(product) > LEAST_COSINE * np.abs(there) * np.abs(heading)  # False for NaN
    return np.where(product < 0, -there, there), straight
