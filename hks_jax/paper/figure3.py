"""Figure 3: four fields of diagonal tensors, and what the HKS sees of them."""

from collections.abc import Callable

import numpy as np
from matplotlib.figure import Figure

from hks_jax import plot
from hks_jax.domain.examples import figure3_fields
from hks_jax.paper.signature import flat_signature

TIME = 1.0
QUICK, FULL = 51, 201
TITLES = (
    r"$T^1 = \mathrm{diag}(f(u_1), 1)$",
    r"$T^2 = \mathrm{diag}(f(u_2), 1)$",
    r"$T^3 = \mathrm{diag}(f(u_2), f(u_1))$",
    r"$T^4 = f(|u|)\, I$",
)


def make(full: bool, echo: Callable[[str], None]) -> Figure:
    """Return the figure."""
    n = FULL if full else QUICK
    fig = plot.new_figure(15, 7.2)
    tops, bottoms = fig.subplots(2, 4, sharex=True, sharey=True)
    fields, images = list(figure3_fields(n).values()), []
    for number, field in enumerate(fields, 1):
        echo(f"figure3: field {number} of {len(fields)}, {n}² nodes")
        images.append(flat_signature(field, TIME, "mirror"))
    for top, title, field in zip(tops, TITLES, fields, strict=True):
        plot.ellipses(top, field, colorbar=top is tops[-1])
        top.set_title(title)
    low, high = np.min(images), np.max(images)
    for bottom, image in zip(bottoms, images, strict=True):
        last = bottom is bottoms[-1]
        plot.scalar_image(bottom, image, fields[0].grid, vmin=low, vmax=high, colorbar=last, interpolation="bilinear")
        bottom.set_xlabel("$u_1$")
    tops[0].set_ylabel("unit circles of the metric\n$u_2$")
    bottoms[0].set_ylabel(rf"$4\pi t\,\mathrm{{HKS}}(t)$ at $t$ = {TIME:g}" + "\n$u_2$")
    return fig
