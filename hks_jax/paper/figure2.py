"""Figure 2: what a boundary does to the HKS, and how a mirror undoes it."""

import math
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from hks_jax import plot
from hks_jax.curvature import hks_expansion
from hks_jax.domain.grid import Grid
from hks_jax.domain.tensor_field import TensorField
from hks_jax.fem.boundary import crop, reflect
from hks_jax.paper.signature import flat_signature

TIME = 0.01
QUICK, FULL = 41, 201
TITLES = ("natural boundary", "reflected strip", "reflected strip, cropped", "mirror", "along $u_2 = 1/2$")


def flat(x: Float[Array, " 2"]) -> Float[Array, "2 2"]:
    """Return the metric of the plane."""
    return jnp.eye(2)


def bump(x: Float[Array, " 2"]) -> Float[Array, "2 2"]:
    """Return a conformal metric with a bump in the middle and one on a side."""
    distances = jnp.sum((x - jnp.array([[0.55, 0.5], [1.0, 0.5]])) ** 2, axis=1)
    return (1 + jnp.sum(jnp.exp(-distances / 0.02))) * jnp.eye(2)


def make(full: bool, echo: Callable[[str], None]) -> Figure:
    """Return the figure."""
    n = FULL if full else QUICK
    grid = Grid.from_bounds(0.0, 1.0, (n, n))
    fig = plot.new_figure(18, 6.8)
    rows = fig.subplots(2, 5, width_ratios=(1, 1, 1, 1, 1.25))
    for row, (name, metric) in zip(rows, {"flat metric": flat, "curved metric": bump}.items(), strict=True):
        field = TensorField.from_function(metric, grid)
        echo(f"{name}, {n}² nodes, three boundaries")
        _row(row, field, name)
    for ax, title in zip(rows[0], TITLES, strict=True):
        ax.set_title(title)
    return fig


def _row(panels: np.ndarray, field: TensorField, name: str) -> None:
    grid = field.grid
    # Over three diffusion lengths, heat falls to exp(−9).
    wide = reflect(field, round(3 * math.sqrt(TIME) / grid.spacing[0]))
    before = flat_signature(wide, TIME)
    images = {
        "natural": flat_signature(field, TIME),
        "strip": np.asarray(crop(jnp.asarray(before), grid)),
        "mirror": flat_signature(field, TIME, "mirror"),
    }
    expansion = 4 * math.pi * TIME * np.asarray(hks_expansion(field, jnp.array([TIME])))[0]
    drawn = [(field, images["natural"]), (wide, before), (field, images["strip"]), (field, images["mirror"])]
    for ax, (domain, values) in zip(panels, drawn, strict=False):
        plot.scalar_image(ax, values, domain.grid, least_range=0.1, interpolation="bilinear")
        ax.set_xlabel("$u_1$")
    panels[1].add_patch(Rectangle((0, 0), 1, 1, fill=False, color="white", linestyle="--"))
    panels[0].set_ylabel(f"{name}\n$u_2$")
    ax, styles = panels[4], (("#440154", "-"), ("#21918c", "-"), ("#f28e2b", "--"), ("0.5", ":"))
    for (label, values), (colour, line) in zip((images | {"expansion": expansion}).items(), styles, strict=True):
        ax.plot(grid.axes[0], values[:, grid.shape[1] // 2], color=colour, linestyle=line, label=label)
    ax.set(xlim=(0, 1), xlabel="$u_1$", ylabel=r"$4\pi t\,\mathrm{HKS}(t)$")
    ax.legend(fontsize="small", frameon=False)
    ax.grid(visible=True, linewidth=0.4, alpha=0.5)
