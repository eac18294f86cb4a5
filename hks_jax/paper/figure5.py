"""Figure 5: isolated degenerate points of index −2 … 3."""

from collections.abc import Callable
from fractions import Fraction

import numpy as np
from matplotlib.figure import Figure

from hks_jax import plot
from hks_jax.domain.examples import degenerate_point_field
from hks_jax.paper.signature import continued_signature

TIME = 0.25
STRIP = 0.7  # at least 1.6 in metric length: heat falls to exp(−1.6²/t) and less
QUICK, FULL = 41, 201
INDICES = tuple(Fraction(n, 2) for n in (-4, -3, -2, -1, 1, 2, 3, 4, 5, 6))


def make(full: bool, echo: Callable[[str], None]) -> Figure:
    """Return the figure."""
    n = FULL if full else QUICK
    fields, images = [degenerate_point_field(float(index), n) for index in INDICES], []
    for index, field in zip(INDICES, fields, strict=True):
        echo(f"figure5: index {index}, {n}² nodes")
        images.append(continued_signature(field, TIME, STRIP))
    low, high = np.min(images), np.max(images)
    fig = plot.new_figure(16, 6.6)
    panels = fig.subplots(2, 5, sharex=True, sharey=True)
    for ax, index, field, values in zip(panels.flat, INDICES, fields, images, strict=True):
        image = plot.scalar_image(ax, values, field.grid, vmin=low, vmax=high, colorbar=False, interpolation="bilinear")
        plot.integral_lines(ax, field, density=0.8, colors="white", linewidths=0.6, alpha=0.8)
        ax.set_title(f"index {str(index).replace('-', '−')}")
    fig.colorbar(image, ax=panels, label=rf"$4\pi t\,\mathrm{{HKS}}(t)$ at $t$ = {TIME:g}", shrink=0.7, aspect=30)
    fig.suptitle("Degenerate points: HKS and lines of the major eigenvector")
    return fig
