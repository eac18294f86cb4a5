"""Figure 1: a surface and the metric that it induces on its parameter domain have the same HKS."""

from collections.abc import Callable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import ConnectionPatch, Rectangle

from hks_jax import plot
from hks_jax.domain.examples import bumpy_torus_field, bumpy_torus_mesh
from hks_jax.domain.grid import Grid
from hks_jax.domain.tensor_field import TensorField
from hks_jax.paper.signature import signature
from hks_jax.paper.table1 import interpolate_periodic

TIME = 1.0
QUICK, FULL = (100, 150), (400, 300)  # nodes per axis, eigenpairs
DRAWN = 200
ANGLES = ("0", "π/4", "π/2", "3π/4", "π", "5π/4", "3π/2")


def make(full: bool, echo: Callable[[str], None]) -> Figure:
    """Return the figure."""
    n, k = FULL if full else QUICK
    field, mesh = bumpy_torus_field(n), bumpy_torus_mesh(n)
    echo(f"{k} eigenpairs of the surface with {n}² vertices, and of its metric")
    (on_surface,) = signature(mesh, [TIME], k)
    (on_domain,) = signature(field, [TIME], k, boundary="periodic")
    low, high = min(on_surface.min(), on_domain.min()), max(on_surface.max(), on_domain.max())

    drawn, values = bumpy_torus_mesh(DRAWN), on_surface.reshape(n, n)
    values = values[:: n // DRAWN, :: n // DRAWN] if n > DRAWN else interpolate_periodic(values, DRAWN // n)

    fig = plot.new_figure(10.5, 8.5)
    surface, surface_hks = (fig.add_subplot(2, 2, i, projection="3d") for i in (1, 2))
    ellipses, domain_hks = (fig.add_subplot(2, 2, i) for i in (3, 4))
    for ax in (surface, surface_hks):
        ax.view_init(elev=42, azim=-60)

    plot.surface(surface, drawn, np.zeros(values.size), cmap="Greys", vmin=-1, vmax=3, relief=0.7, zoom=1.35)
    surface.set_title("surface $M = f(U)$")
    mappable = plot.surface(surface_hks, drawn, values.ravel(), vmin=low, vmax=high, zoom=1.35)
    surface_hks.set_title("HKS of the surface")
    part = slice(n // 4, 3 * n // 4 + 1)
    quarter = TensorField(
        Grid((part.stop - part.start,) * 2, field.grid.spacing, field.grid.axes[0][part.start]),
        field.tensors[part, part],
    )
    plot.ellipses(ellipses, quarter, every=n // 50, sizes="fit")
    ellipses.set_title("metric $f^{*}g$ on the middle of $U$: its unit circles")
    plot.scalar_image(domain_hks, on_domain, field.grid, vmin=low, vmax=high, colorbar=False)
    domain_hks.set_title("HKS of the metric on $U$")
    domain_hks.add_patch(Rectangle((np.pi / 2,) * 2, np.pi, np.pi, fill=False, color="white", linestyle="--"))
    angle_axes(ellipses, np.arange(2, 7))
    angle_axes(domain_hks, np.arange(0, 8, 2))
    fig.colorbar(mappable, ax=[surface_hks, domain_hks], label=f"HKS at $t$ = {TIME:g}", shrink=0.6, aspect=30)
    fractions = "axes fraction"
    patch = ConnectionPatch((0.5, 0.0), (0.5, 1.12), fractions, fractions, axesA=surface, axesB=ellipses)
    patch.set(arrowstyle="-|>", mutation_scale=14, color="black")
    fig.add_artist(patch)
    ellipses.text(0.52, 1.14, "pull back", transform=ellipses.transAxes, va="bottom")
    fig.suptitle("The heat kernel signature belongs to the metric, not to the embedding")
    return fig


def angle_axes(ax: Axes, quarters: np.ndarray) -> None:
    """Label axes at multiples of π/4."""
    ticks, names = np.pi / 4 * quarters, [ANGLES[q] for q in quarters]
    ax.set_xticks(ticks, names)
    ax.set_yticks(ticks, names)
    ax.set_xlabel("$u$")
    ax.set_ylabel("$v$")
