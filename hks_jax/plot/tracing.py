"""Integral lines of the eigenvector fields of a 2D tensor field.

Eigenvectors have no sign, so tensors instead of eigenvectors are interpolated bilinearly between the nodes. The
direction at a point follows from the interpolated tensor in closed form, and its sign from the previous direction.
"""

import math
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial import cKDTree

from hks_jax.checks import real_array
from hks_jax.domain.tensor_field import TensorField
from hks_jax.plot.figure import frame, plane_of, side_in_inches

Which = Literal["major", "minor"]

# A line ends where (λ₁ − λ₂)/(λ₁ + λ₂) falls below `DEGENERATE`, or where it would turn by more than 60° in a step.
DEGENERATE = 1e-3
LEAST_COSINE = 0.5


class DirectionField:
    """The major or minor eigenvector direction of a field at any point, or NaN at degenerate points.

    The major direction belongs to the larger eigenvalue of the field's tensors, for metrics and diffusion tensors.
    """

    def __init__(self, field: TensorField, which: Which) -> None:
        plane_of(field)
        if which not in ("major", "minor"):
            raise ValueError(f'which: got {which!r}; expected "major" or "minor"')
        grid = field.grid
        tensors = np.asarray(field.domain_tensors, dtype=np.float64)
        self.which = which
        # For eigenvalues λ₁ ≥ λ₂ and the major angle θ, components are (λ₁ − λ₂) cos 2θ, (λ₁ − λ₂) sin 2θ and λ₁ + λ₂.
        difference = tensors[..., 0, 0] - tensors[..., 1, 1]
        components = np.stack([difference, 2 * tensors[..., 0, 1], np.trace(tensors, axis1=-2, axis2=-1)], -1)
        components[~grid.inside] = np.nan
        self.interpolant = RegularGridInterpolator(grid.axes, components, bounds_error=False)

    def __call__(
        self, points: Float[np.ndarray, "n 2"], towards: Float[np.ndarray, "n 2"] | None = None
    ) -> Float[np.ndarray, "n 2"]:
        """Return unit vectors (n, 2) within 90° of `towards`, or NaN outside the domain and at degenerate points."""
        a, b, trace = self.interpolant(points).T
        with np.errstate(invalid="ignore"):
            angle = 0.5 * np.arctan2(b, a)
            angle[~(np.hypot(a, b) > DEGENERATE * trace)] = np.nan
        direction = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        if self.which == "minor":
            direction = np.stack([-direction[:, 1], direction[:, 0]], axis=1)
        if towards is not None:
            direction[np.einsum("ni,ni->n", direction, towards) < 0] *= -1
        return direction


def trace(
    field: TensorField,
    seeds: Float[np.ndarray, "n 2"],
    which: Which = "major",
    *,
    step: float | None = None,
    max_length: float | None = None,
) -> list[Float[np.ndarray, "m 2"]]:
    """Return the integral lines through the seeds in both directions.

    All lines are computed at once with fixed steps of the classical Runge–Kutta method. A line ends at the boundary of
    the domain, near a degenerate point, or at half of `max_length` from its seed.

    Args:
        field: a 2D field.
        seeds: (n, 2) coordinates.
        which: ``"major"`` (larger eigenvalue) or ``"minor"``.
        step: the arc length of a step in coordinates, by default half the smaller grid spacing.
        max_length: the maximum arc length, by default eight times the longer side of the grid.

    Returns:
        An (m, 2) array of consecutive points for each seed, or (0, 2) for a seed without a direction.

    Examples:
        >>> (line,) = hj.plot.trace(field, np.array([[0.5, 0.5]]))
        >>> print(np.ptp(np.hypot(*(line + 0.3).T)) < 0.01)  # an arc of a circle about (−0.3, −0.3)
        True
    """
    plane_of(field)
    points = np.asarray(real_array("seeds", seeds), dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 2:
        raise ValueError(f"seeds: got shape {points.shape}; expected (n, 2)")
    forward, backward = _both_ways(DirectionField(field, which), points, *_lengths(field, step, max_length))
    return [np.concatenate([b[:0:-1], f]) if len(f) else f for f, b in zip(forward, backward, strict=True)]


def evenly_spaced_lines(
    field: TensorField,
    which: Which = "major",
    *,
    separation: float,
) -> list[Float[np.ndarray, "m 2"]]:
    """Return integral lines that fill the domain at distances of about `separation`, in coordinate units.

    The method is due to Jobard and Lefer, “Creating evenly-spaced streamlines of arbitrary density” (1997). Each new
    line starts as close as allowed to the existing lines. A line ends where it is closer than half the separation to
    another line or to itself. Circles are closed.

    Args:
        field: a 2D field.
        which: ``"major"`` or ``"minor"``.
        separation: the distance between neighbouring lines where they start. Lines shorter than twice the
            separation are omitted.

    Examples:
        >>> lines = hj.plot.evenly_spaced_lines(field, separation=0.2)
        >>> print(max(np.ptp(np.hypot(*(line + 0.3).T)) for line in lines) < 0.01)  # arcs of circles
        True
    """
    plane_of(field)
    if not 0 < separation < math.inf:
        raise ValueError(f"separation: got {separation}; expected a positive length, in the unit of the coordinates")
    h, n_steps = _lengths(field, None, None)
    h = min(h, separation / 4)
    seeds = _candidates(field, separation / 2)
    forward, backward = _both_ways(DirectionField(field, which), seeds, h, n_steps)
    lines: list[np.ndarray] = []
    tree: cKDTree | None = None
    centre = np.array([0.5 * (a[0] + a[-1]) for a in field.grid.axes])
    # The distance from each possible seed to the existing lines or, for the first line, to a point near the middle.
    distance = separation + np.linalg.norm(seeds - centre - 0.3 * separation, axis=1)
    free = np.array([len(f) > 0 for f in forward])
    while True:
        allowed = free & (distance >= separation)
        if not allowed.any():
            return lines
        index = int(np.argmin(np.where(allowed, distance, np.inf)))
        free[index] = False
        line = _grow(forward[index], backward[index], tree, separation / 2, h)
        if (len(line) - 1) * h < 2 * separation:
            continue
        if not lines:
            distance[:] = np.inf
        lines.append(line)
        tree = cKDTree(np.concatenate(lines))
        distance = np.minimum(distance, cKDTree(line).query(seeds)[0])


def _grow(forward: np.ndarray, backward: np.ndarray, others: cKDTree | None, gap: float, step: float) -> np.ndarray:
    """Cut a line where it is closer than `gap` to other lines or to itself; close the line if its ends meet."""
    if others is not None:
        forward, backward = (half[: _first(others.query(half)[0] < gap)] for half in (forward, backward))
    # Points that are fewer than `lag` steps apart may be close only because they are neighbours on the line.
    lag = int(np.ceil(np.pi * gap / step)) + 1
    end = _first_return(forward, lag, gap)
    if end < len(forward):
        ahead = forward[end : end + lag]
        nearest = int(np.argmin(np.linalg.norm(ahead - forward[0], axis=1)))
        if np.linalg.norm(ahead[nearest] - forward[0]) <= 0.75 * step:
            return np.concatenate([forward[: end + nearest], forward[:1]])
        forward = forward[:end]
    line = np.concatenate([forward[::-1], backward[1:]])
    return line[: _first_return(line, lag, gap)]


def _first_return(line: np.ndarray, lag: int, gap: float) -> int:
    """Return the first index whose point is within `gap` of a point at least `lag` earlier, or the line's length."""
    n = len(line)
    if n <= lag:
        return n
    apart = np.linalg.norm(line[:, None] - line[None], axis=-1)
    earlier = np.tril(np.ones((n, n), dtype=bool), -lag)
    return _first(np.any(earlier & (apart < gap), axis=1))


def _first(condition: np.ndarray) -> int:
    return int(np.argmax(condition)) if condition.any() else len(condition)


def _both_ways(
    direction: DirectionField, seeds: np.ndarray, step: float, n_steps: int
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Trace from each seed forwards and backwards; both halves begin with the seed if it has a direction."""
    start = direction(seeds)
    points, heading = np.concatenate([seeds, seeds]), np.concatenate([start, -start])
    alive = np.flatnonzero(np.isfinite(heading[:, 0]))
    track = np.full((n_steps + 1, *points.shape), np.nan)
    x, d = points[alive], heading[alive]
    track[0, alive] = x
    for n in range(1, n_steps + 1):
        k1 = direction(x, d)
        k2 = direction(x + 0.5 * step * k1, k1)
        k3 = direction(x + 0.5 * step * k2, k2)
        k4 = direction(x + step * k3, k3)
        x = x + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        new = direction(x, k4)
        goes_on = np.einsum("ni,ni->n", new, d) > LEAST_COSINE  # False for NaN too
        alive, x, d = alive[goes_on], x[goes_on], new[goes_on]
        if alive.size == 0:
            break
        track[n, alive] = x
    lengths = np.isfinite(track[..., 0]).sum(axis=0)
    halves = [track[:m, i] for i, m in enumerate(lengths)]
    return halves[: len(seeds)], halves[len(seeds) :]


def _lengths(field: TensorField, step: float | None, max_length: float | None) -> tuple[float, int]:
    grid = field.grid
    h = 0.5 * min(grid.spacing) if step is None else step
    side = max((n - 1) * s for n, s in zip(grid.shape, grid.spacing, strict=True))
    length = 8.0 * side if max_length is None else max_length
    if not (0 < h < math.inf and 0 < length < math.inf):
        raise ValueError(f"step, max_length: got {step}, {max_length}; expected positive lengths in coordinate units")
    return h, max(1, int(np.ceil(0.5 * length / h)))


def _candidates(field: TensorField, spacing: float) -> np.ndarray:
    axes = field.grid.axes
    counts = [max(2, int(np.ceil((a[-1] - a[0]) / spacing))) for a in axes]
    widths = [(a[-1] - a[0]) / n for a, n in zip(axes, counts, strict=True)]
    mids = [a[0] + w * (np.arange(n) + 0.5) for a, w, n in zip(axes, widths, counts, strict=True)]
    points = np.stack(np.meshgrid(*mids, indexing="ij"), axis=-1).reshape(-1, 2)
    return points + np.random.default_rng(0).uniform(-0.2, 0.2, points.shape) * widths


def integral_lines(
    ax: Axes,
    field: TensorField,
    which: Which = "major",
    *,
    seeds: Float[np.ndarray, "n 2"] | None = None,
    density: float = 1.0,
    **kwargs: Any,
) -> LineCollection:
    """Draw integral lines of an eigenvector field on `ax`.

    Args:
        ax: the axes to draw on.
        field: a 2D field.
        which: ``"major"``, the eigenvector of the larger eigenvalue of T, or ``"minor"``.
        seeds: (n, 2) points on the lines, by default the seeds of evenly spaced lines.
        density: the density of evenly spaced lines. At a density of 1, the distance between lines is 1/25 of the longer
            side or, on small axes, more.
        **kwargs: arguments of `matplotlib.collections.LineCollection` (``colors``, ``linewidths``, ``alpha``).

    Raises:
        ValueError: if the field is 3D, an option is unknown, or a size is not positive.

    Examples:
        >>> ax = hj.plot.new_figure(3, 3).add_subplot()
        >>> lines = hj.plot.integral_lines(ax, field, seeds=np.array([[0.5, 0.5], [0.2, 0.2]]))
        >>> len(lines.get_segments())
        2
    """
    plane_of(field)
    if seeds is None:
        if not density > 0:
            raise ValueError(f"density: got {density}; expected a positive number")
        x0, x1, y0, y1 = field.grid.extent
        side = max(x1 - x0, y1 - y0)
        gaps = min(25.0, max(4.0, 11 * side_in_inches(ax, (x1 - x0, y1 - y0))))
        lines = evenly_spaced_lines(field, which, separation=side / (gaps * density))
    else:
        lines = [line for line in trace(field, seeds, which) if len(line) > 1]
    collection = LineCollection(lines, **{"colors": "black", "linewidths": 0.7, "capstyle": "round", **kwargs})
    frame(ax, field.grid)
    ax.add_collection(collection, autolim=False)
    return collection
