"""Figure 2: what a boundary does to the HKS, and how a mirror undoes it."""

import math
from collections.abc import Callable
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from matplotlib.axes import Axes

from hks_jax import plot
from hks_jax.curvature import hks_expansion
from hks_jax.domain.grid import Grid
from hks_jax.domain.tensor_field import TensorField
from hks_jax.fem.boundary import crop, reflect
from hks_jax.paper.signature import enough_pairs, signature

TIME = 0.01
QUICK, FULL = 41, 201


def flat(x: Float[Array, " 2"]) -> Float[Array, "2 2"]:
    """Return the metric of the plane."""
    return jnp.eye(2)


def bump(x: Float[Array, " 2"]) -> Float[Array, "2 2"]:
    """Return a conformal metric with a bump in the middle and one on a side."""
    distances = jnp.sum((x - jnp.array([[0.55, 0.5], [1.0, 0.5]])) ** 2, axis=1)
    return (1 + jnp.sum(jnp.exp(-distances / 0.02))) * jnp.eye(2)


def figure2(output: Path, full: bool, echo: Callable[[str], None]) -> list[Path]:
    """Write ``figure2.png``."""
    n = FULL if full else QUICK
    grid = Grid.from_bounds(0.0, 1.0, (n, n))
    fig = plot.new_figure(14.5, 6.8)
    rows = fig.subplots(2, 4, width_ratios=(1, 1, 1, 1.25))
    for row, (name, metric) in zip(rows, {"flat metric": flat, "curved metric": bump}.items(), strict=True):
        field = TensorField.from_function(metric, grid)
        echo(f"figure2: {name}, {n}² nodes, three boundaries")
        _row(row, field, name)
    for ax, title in zip(rows[0], ("natural boundary", "reflected strip, cropped", "mirror"), strict=False):
        ax.set_title(title)
    rows[0, 3].set_title("along $u_2 = 1/2$")
    return [plot.save_figure(fig, output / "figure2.png")]


def _row(panels: np.ndarray, field: TensorField, name: str) -> None:
    grid = field.grid
    # Over three diffusion lengths, heat falls to exp(−9).
    wide = reflect(field, round(3 * math.sqrt(TIME) / grid.spacing[0]))
    images = {
        "natural": _signature(field, "neumann"),
        "strip": np.asarray(crop(jnp.asarray(_signature(wide, "neumann")), grid)),
        "mirror": _signature(field, "mirror"),
    }
    expansion = 4 * math.pi * TIME * np.asarray(hks_expansion(field, jnp.array([TIME])))[0]
    for ax, values in zip(panels, images.values(), strict=False):
        plot.scalar_image(ax, values, grid, least_range=0.1, interpolation="bilinear")
        ax.set_xlabel("$u_1$")
    panels[0].set_ylabel(f"{name}\n$u_2$")
    _profiles(panels[3], grid, images, expansion)


def _signature(field: TensorField, boundary: str) -> np.ndarray:
    return signature(field, [TIME], enough_pairs(field, TIME, boundary), boundary, normalisation="flat")[0]


def _profiles(ax: Axes, grid: Grid, images: dict[str, np.ndarray], expansion: np.ndarray) -> None:
    middle = grid.shape[1] // 2
    styles = {"natural": ("#440154", "-"), "strip": ("#21918c", "-"), "mirror": ("#f28e2b", "--")}
    for name, values in images.items():
        colour, line = styles[name]
        ax.plot(grid.axes[0], values[:, middle], color=colour, linestyle=line, label=name)
    ax.plot(grid.axes[0], expansion[:, middle], color="0.5", linestyle=":", label="expansion")
    ax.set_xlim(0, 1)
    ax.set_xlabel("$u_1$")
    ax.set_ylabel(r"$4\pi t\,\mathrm{HKS}(t)$")
    ax.legend(fontsize="small", frameon=False)
    ax.grid(visible=True, linewidth=0.4, alpha=0.5)
