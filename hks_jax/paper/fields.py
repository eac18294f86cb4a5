"""Figures 3 to 5: fields of tensors, drawn as ellipses or integral lines, and their HKS."""

from collections.abc import Callable
from fractions import Fraction

import numpy as np
from matplotlib.figure import Figure

from hks_jax import plot
from hks_jax.domain.examples import degenerate_point_field, figure3_fields, figure4_fields
from hks_jax.paper.signature import continued_signature, flat_signature

SIZES = {"figure3": (51, 201), "figure4": (47, 201), "figure5": (41, 201)}
"""Nodes per axis, quick and full."""
INDICES = tuple(Fraction(n, 2) for n in (-4, -3, -2, -1, 1, 2, 3, 4, 5, 6))
SIGNATURE = r"$4\pi t\,\mathrm{HKS}(t)$ at $t$ = "
TITLES = (
    r"$T^1 = \mathrm{diag}(f(u_1), 1)$",
    r"$T^2 = \mathrm{diag}(f(u_2), 1)$",
    r"$T^3 = \mathrm{diag}(f(u_2), f(u_1))$",
    r"$T^4 = f(|u|)\, I$",
)


def figure3(full: bool, echo: Callable[[str], None]) -> Figure:
    """Return Figure 3: four fields of diagonal tensors, and what the HKS sees of them."""
    n, time = SIZES["figure3"][full], 1.0
    fields, images = list(figure3_fields(n).values()), []
    for number, field in enumerate(fields, 1):
        echo(f"field {number} of {len(fields)}, {n}² nodes")
        images.append(flat_signature(field, time, "mirror"))
    fig = plot.new_figure(15, 7.2)
    tops, bottoms = fig.subplots(2, 4, sharex=True, sharey=True)
    style = {"vmin": np.min(images), "vmax": np.max(images), "interpolation": "bilinear"}
    for top, bottom, title, field, image in zip(tops, bottoms, TITLES, fields, images, strict=True):
        last = top is tops[-1]
        plot.ellipses(top, field, colorbar=last)
        plot.scalar_image(bottom, image, field.grid, colorbar=last, **style)
        top.set_title(title)
        bottom.set_xlabel("$u_1$")
    tops[0].set_ylabel("unit circles of the metric\n$u_2$")
    bottoms[0].set_ylabel(f"{SIGNATURE}{time:g}\n$u_2$")
    return fig


def figure4(full: bool, echo: Callable[[str], None]) -> Figure:
    """Return Figure 4: constant eigenvalues, varying eigenvectors: the HKS sees how the integral lines bend."""
    n, time = SIZES["figure4"][full], 0.01
    strip = 0.28  # heat falls to exp(−strip²/t) = exp(−8); the circles' and spirals' centre is further out
    fields = figure4_fields(n)
    fig = plot.new_figure(3.6 * len(fields) + 0.6, 7.2)
    tops, bottoms = fig.subplots(2, len(fields), sharex=True, sharey=True)
    for top, bottom, (name, field) in zip(tops, bottoms, fields.items(), strict=True):
        echo(f"{name}, {n}² nodes")
        values = continued_signature(field, time, strip)
        plot.integral_lines(top, field, "minor", density=0.7, colors="tab:orange", linewidths=0.5)
        plot.integral_lines(top, field, "major", density=0.7, colors="black")
        plot.scalar_image(bottom, values, field.grid, least_range=0.1, interpolation="bilinear")
        plot.integral_lines(bottom, field, "major", density=0.7, colors="white", alpha=0.7)
        top.set_title(name)
        bottom.set_xlabel("$u_1$")
    tops[0].set_ylabel("major (black), minor lines\n$u_2$")
    bottoms[0].set_ylabel(f"{SIGNATURE}{time:g}\n$u_2$")
    fig.suptitle("Constant eigenvalues, turning eigenvectors: the first three fields are flat, the others are not")
    return fig


def figure5(full: bool, echo: Callable[[str], None]) -> Figure:
    """Return Figure 5: isolated degenerate points of index −2 … 3."""
    n, time = SIZES["figure5"][full], 0.25
    strip = 0.7  # at least 1.6 in metric length: heat falls to exp(−1.6²/t) and less
    fields, images = [degenerate_point_field(float(index), n) for index in INDICES], []
    for index, field in zip(INDICES, fields, strict=True):
        echo(f"index {index}, {n}² nodes")
        images.append(continued_signature(field, time, strip))
    fig = plot.new_figure(16, 6.6)
    panels = fig.subplots(2, 5, sharex=True, sharey=True)
    style = {"vmin": np.min(images), "vmax": np.max(images), "interpolation": "bilinear", "colorbar": False}
    for ax, index, field, values in zip(panels.flat, INDICES, fields, images, strict=True):
        image = plot.scalar_image(ax, values, field.grid, **style)
        plot.integral_lines(ax, field, density=0.8, colors="white", linewidths=0.6, alpha=0.8)
        ax.set_title(f"index {str(index).replace('-', '−')}")
    fig.colorbar(image, ax=panels, label=f"{SIGNATURE}{time:g}", shrink=0.7, aspect=30)
    fig.suptitle("Degenerate points: HKS and lines of the major eigenvector")
    return fig
