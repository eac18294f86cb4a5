"""Line integral convolution, which averages noise along an eigenvector field to show its directions everywhere."""

from typing import Any

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Bool, Complex, Float, Real
from matplotlib.axes import Axes
from matplotlib.image import AxesImage
from scipy.special import ndtr

from hks_jax.domain.components import active_elements
from hks_jax.domain.tensor_field import TensorField
from hks_jax.plot.figure import frame, plane_of, side_in_inches
from hks_jax.plot.images import scalar_image
from hks_jax.plot.tracing import LEAST_COSINE, DirectionField, Which

PIXELS_PER_INCH = 110
"""The texture's resolution, at which single grains are visible in print and on screens."""

FRAME = 3
"""The width in pixels of the border around the texture, which exceeds the length of an integration step."""


def lic_texture(
    field: TensorField, which: Which = "major", *, pixels: int = 400, length: int = 25, seed: int = 0
) -> Float[np.ndarray, "px py"]:
    """Return white noise averaged along the integral lines of an eigenvector field (Cabral and Leedom 1993).

    Eigenvectors have no sign, so each integration step chooses the sign that prevents a reversal of the line. The
    weights of the average are bell-shaped. The averaged noise is divided by its standard deviation and mapped by the
    normal distribution function to uniform numbers in (0, 1), so that the contrast is the same where lines end.

    Args:
        field: a 2D field.
        which: ``"major"``, the eigenvector of the larger eigenvalue of T, or ``"minor"``.
        pixels: the number of pixels along the longer side of the grid.
        length: the number of pixels along which noise is averaged in each direction of a line.
        seed: the seed of the noise.

    Returns:
        (px, py) over the rectangle of the nodes, `field.grid.extent`, with array axis 0 horizontal; NaN in cells
        outside the mask. Where eigenvalues are equal the noise is not averaged.

    Raises:
        ValueError: if the field is 3D, `which` is unknown, `pixels` is less than 2, or `length` is less than 1.

    Examples:
        >>> texture = hj.plot.lic_texture(field, pixels=64)
        >>> texture.shape, round(float(texture.mean()), 1)  # uniform in (0, 1)
        ((64, 64), 0.5)
    """
    direction = DirectionField(field, which)
    if pixels < 2 or length < 1:
        raise ValueError(f"pixels, length: got {pixels}, {length}; expected at least 2 pixels and a length ≥ 1")
    x0, x1, y0, y1 = field.grid.extent
    side = max(x1 - x0, y1 - y0) / pixels
    shape = (max(2, round((x1 - x0) / side)), max(2, round((y1 - y0) / side)))
    size = np.array([(x1 - x0) / shape[0], (y1 - y0) / shape[1]])
    centres = np.moveaxis(np.indices(shape), 0, -1).reshape(-1, 2) + 0.5
    points = [x0, y0] + centres * size
    noise = np.random.default_rng(seed).standard_normal(shape).astype(np.float32)
    # For integration steps of one pixel, the direction at every pixel suffices. Complex numbers represent vectors. A
    # border of NaN ends lines that leave the image, because bounds checks would take most of the run time.
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
            # The midpoint rule is used because Euler's method would spiral out of circles.
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
    **kwargs: Any,
) -> AxesImage:
    """Shade an image by the line integral convolution of an eigenvector field.

    The texture darkens and lightens colours equally, so on average the colours agree with the colour bar.

    Args:
        ax: the axes to draw on.
        field: a 2D field.
        which: ``"major"`` or ``"minor"``.
        values: (*shape,) a scalar such as the HKS, drawn by `scalar_image`; by default the image on `ax`, or grey.
        contrast: the maximum opacity of black and white, in (0, 1].
        pixels: the number of pixels along the texture's longer side, by default about 110 per inch of the axes.
        length: the same as for `lic_texture`.
        **kwargs: arguments of `scalar_image` for `values`.

    Returns:
        The image of the texture.

    Raises:
        ValueError: if the field is 3D, or if an option is unknown or out of range.

    Examples:
        >>> ax = hj.plot.new_figure(3, 3).add_subplot()
        >>> image = hj.plot.line_integral_convolution(ax, field, values=hj.hks(pairs, [0.5])[0], pixels=64)
        >>> image.get_array().shape
        (64, 64, 4)
    """
    plane_of(field)
    if not 0 < contrast <= 1:
        raise ValueError(f"contrast: got {contrast}; expected a number in (0, 1]")
    grid = field.grid
    if kwargs.get("orientation") is not None:
        field = kwargs["orientation"].field(field)
    x0, x1, y0, y1 = field.grid.extent
    if pixels is None:
        pixels = int(np.clip(PIXELS_PER_INCH * side_in_inches(ax, (x1 - x0, y1 - y0)), 100, 1200))
    texture = lic_texture(field, which, pixels=pixels, length=length)
    if values is not None:
        scalar_image(ax, values, grid, **{"interpolation": "bilinear", **kwargs})
    shift = contrast * (2 * texture.T - 1)
    shade = np.zeros((*shift.shape, 4))
    if ax.images:
        # A black pixel of opacity p multiplies the colour below by 1 − p. A white pixel of opacity p multiplies the
        # distance of the colour below to white by 1 − p.
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
    """Return the direction at each position with the sign that continues the line, and whether the line continues."""
    there = along[_pixel(position)]
    product = (there * heading.conj()).real
    straight = np.abs(product) > LEAST_COSINE * np.abs(there) * np.abs(heading)  # False for NaN
    return np.where(product < 0, -there, there), straight
