"""Figures 1 to 6: the HKS of a surface, near boundaries, of tensor fields and of a slice of a brain."""

import importlib.util
import math
from collections.abc import Callable
from fractions import Fraction

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from matplotlib.figure import Figure
from matplotlib.patches import ConnectionPatch, Rectangle
from signature import continued_signature, enough_pairs, flat_signature, signature, signature_and_influence
from table1 import interpolate_periodic

from hks_jax import plot
from hks_jax.curvature import hks_expansion
from hks_jax.domain.examples import (
    bumpy_torus_field,
    bumpy_torus_mesh,
    degenerate_point_field,
    figure3_fields,
    figure4_fields,
)
from hks_jax.domain.grid import Grid
from hks_jax.domain.tensor_checks import MetricChoice
from hks_jax.domain.tensor_field import TensorField
from hks_jax.fem.boundary import crop, reflect
from hks_jax.io import erode, find_example_brain, fit_dwi
from hks_jax.plot.figure import RIM_NOTE
from hks_jax.plot.panels import BESIDE
from hks_jax.plot.signature import cropped, free_colours, placed
from hks_jax.signatures.times import FREE

SIZES: dict[str, tuple] = {
    "figure1": ((100, 150), (400, 300)),
    "figure2": (41, 201),
    "figure3": (51, 201),
    "figure4": (47, 201),
    "figure5": (41, 201),
}
"""The nodes per axis of quick and full runs, and for Figure 1 the number of eigenpairs."""
TIMES = {"figure1": 1.0, "figure2": 0.01, "figure3": 1.0, "figure4": 0.01, "figure5": 0.25}
LENGTHS = (5.0, 7.0, 10.0, 14.0)
"""The diffusion lengths of the columns of Figure 6 in mm; at longer ones, the boundary reaches most of the slice. For
the metric D, the time is the squared length times the median diffusivity; for the metric D⁻¹, the time is the squared
length divided by the median diffusivity."""
DRAWN = 200
"""The vertices per axis of the drawn surface in Figure 1."""
ANGLES = ("0", "π/4", "π/2", "3π/4", "π", "5π/4", "3π/2")
BOUNDARIES = ("natural boundary", "reflected strip", "reflected strip, cropped", "mirror", "along $u_2 = 1/2$")
INDICES = tuple(Fraction(n, 2) for n in (-4, -3, -2, -1, 1, 2, 3, 4, 5, 6))
SIGNATURE = r"$4\pi t\,\mathrm{HKS}(t)$ at $t$ = "
TITLES = (
    r"$T^1 = \mathrm{diag}(f(u_1), 1)$",
    r"$T^2 = \mathrm{diag}(f(u_2), 1)$",
    r"$T^3 = \mathrm{diag}(f(u_2), f(u_1))$",
    r"$T^4 = f(|u|)\, I$",
)


def figure1(full: bool, echo: Callable[[str], None]) -> Figure:
    """Return Figure 1, in which a surface and its induced metric on the parameter domain have the same HKS."""
    (n, k), time = SIZES["figure1"][full], TIMES["figure1"]
    field, mesh = bumpy_torus_field(n), bumpy_torus_mesh(n)
    echo(f"{k} eigenpairs of the surface with {n}² vertices, and of its metric on {n}² nodes")
    (on_surface,) = signature(mesh, [time], k)
    (on_domain,) = signature(field, [time], k, boundary="periodic")
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
    ellipses.set_title("unit circles of the metric $f^{*}g$ in the middle of $U$")
    plot.scalar_image(domain_hks, on_domain, field.grid, vmin=low, vmax=high, colorbar=False)
    domain_hks.set_title("HKS of the metric on $U$")
    domain_hks.add_patch(Rectangle((np.pi / 2,) * 2, np.pi, np.pi, fill=False, color="white", linestyle="--"))
    for ax, quarters in ((ellipses, np.arange(2, 7)), (domain_hks, np.arange(0, 8, 2))):
        ticks, names = np.pi / 4 * quarters, [ANGLES[q] for q in quarters]
        ax.set(xticks=ticks, xticklabels=names, yticks=ticks, yticklabels=names, xlabel="$u$", ylabel="$v$")
    fig.colorbar(mappable, ax=[surface_hks, domain_hks], label=f"HKS at $t$ = {time:g}", shrink=0.6, aspect=30)
    fractions = "axes fraction"
    patch = ConnectionPatch((0.5, 0.0), (0.5, 1.12), fractions, fractions, axesA=surface, axesB=ellipses)
    patch.set(arrowstyle="-|>", mutation_scale=14, color="black")
    fig.add_artist(patch)
    ellipses.text(0.52, 1.14, "pull back", transform=ellipses.transAxes, va="bottom")
    fig.suptitle("The heat kernel signature belongs to the metric, not to the embedding")
    return fig


def _bump(x: Float[Array, " 2"]) -> Float[Array, "2 2"]:
    """Return a conformal metric with one bump in the middle and one on a side."""
    distances = jnp.sum((x - jnp.array([[0.55, 0.5], [1.0, 0.5]])) ** 2, axis=1)
    return (1 + jnp.sum(jnp.exp(-distances / 0.02))) * jnp.eye(2)


def figure2(full: bool, echo: Callable[[str], None]) -> Figure:
    """Return Figure 2, which shows the effect of a boundary on the HKS and its removal by a mirror."""
    n = SIZES["figure2"][full]
    grid = Grid.from_bounds(0.0, 1.0, (n, n))
    fig = plot.new_figure(18, 6.8)
    rows = fig.subplots(2, 5, width_ratios=(1, 1, 1, 1, 1.25))
    metrics = {"flat metric": lambda x: jnp.eye(2), "curved metric": _bump}
    for row, (name, metric) in zip(rows, metrics.items(), strict=True):
        field = TensorField.from_function(metric, grid)
        echo(f"{name}, {n}² nodes, three boundaries")
        _row(row, field, name)
    for ax, title in zip(rows[0], BOUNDARIES, strict=True):
        ax.set_title(title)
    return fig


def _row(panels: np.ndarray, field: TensorField, name: str) -> None:
    grid, time = field.grid, TIMES["figure2"]
    # Over three diffusion lengths √t, heat decays to exp(−9).
    wide = reflect(field, round(3 * math.sqrt(time) / grid.spacing[0]))
    before = flat_signature(wide, time)
    images = {
        "natural": flat_signature(field, time),
        "strip": np.asarray(crop(jnp.asarray(before), grid)),
        "mirror": flat_signature(field, time, "mirror"),
    }
    expansion = 4 * math.pi * time * np.asarray(hks_expansion(field, jnp.array([time])))[0]
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


def figure3(full: bool, echo: Callable[[str], None]) -> Figure:
    """Return Figure 3, which shows four fields of diagonal tensors and their HKS."""
    n, time = SIZES["figure3"][full], TIMES["figure3"]
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
    """Return Figure 4, which shows fields of constant eigenvalues and varying eigenvectors, and their HKS."""
    n, time = SIZES["figure4"][full], TIMES["figure4"]
    # Across the width of the strip, heat decays to exp(−width²/t) = exp(−8). The strip does not reach the singular
    # centres of the fields of circles and spirals.
    strip = 0.28
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
    """Return Figure 5, which shows the HKS around isolated degenerate points of index −2 to 3."""
    n, time = SIZES["figure5"][full], TIMES["figure5"]
    strip = 0.7  # the strip has a metric width of at least 1.6, across which heat decays to exp(−1.6²/t) or less
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


def figure6(full: bool, echo: Callable[[str], None]) -> Figure | dict[str, str]:
    """Return Figure 6 for the brain of ``hks-jax demo``, or nothing where that brain or DIPY is not installed."""
    brain = find_example_brain()
    if brain is None or importlib.util.find_spec("dipy") is None:
        echo('skipped: the brain is in the wheel mdt==1.2.7 (pip install --no-deps), and its fit needs "hks-jax[dti]"')
        return {}
    volume = fit_dwi(brain.images, brain.bval, brain.bvec, brain.mask, b_max=1000.0).slice("z", 0)
    volume = volume.with_mask(erode(volume.inside, 2))
    inside = volume.grid("largest").inside
    shown, box = cropped(volume, inside)
    orientation = placed(volume, box, "neurological")
    tensors = volume.tensors[box]
    grid = Grid(shown.shape, shown.spacing, shown.origin, inside[box])
    diffusivity = np.trace(tensors, axis1=-2, axis2=-1) / 2
    anisotropy = np.ptp(np.linalg.eigvalsh(tensors), axis=-1) / np.maximum(2 * diffusivity, 1e-12)
    typical = float(np.median(diffusivity[grid.inside]))
    rows: dict[MetricChoice, tuple[str, float, str]] = {
        "tensor": ("$D$", typical, "mm⁴/s"),
        "inverse": ("$D^{-1}$", 1 / typical, "s"),
    }

    fig = plot.new_figure(12.4, 6.7)
    panels = fig.subplots(2, 5, sharex=True, sharey=True)
    scalars = {
        "mean diffusivity\nin $10^{-3}$ mm²/s": 1e3 * diffusivity,
        "anisotropy\n$(λ_1 - λ_2)/(λ_1 + λ_2)$": anisotropy,
    }
    for ax, (title, scalar) in zip(panels[:, 0], scalars.items(), strict=True):
        plot.scalar_image(ax, scalar, grid, orientation=orientation, **BESIDE)
        ax.set_title(title, fontsize="medium")
        ax.set_ylabel("mm", fontsize="small")
    for row, (metric, (name, area, unit)) in zip(panels[:, 1:], rows.items(), strict=True):
        field = TensorField.from_diffusion(grid, tensors, metric=metric)
        times = [length**2 * area for length in LENGTHS]
        k = 2 * enough_pairs(field, times[0], exponent=10.0 if full else 6.0)
        echo(f"metric {metric}, {int(grid.inside.sum())} nodes, {k} eigenpairs of both boundary problems")
        values, influence = signature_and_influence(field, times, k)
        near = influence > FREE
        colours = free_colours(values, near, grid.inside, 1.0)
        for i, (ax, t, length) in enumerate(zip(row, times, LENGTHS, strict=True)):
            low, high, cmap = colours[i]
            style = {"vmin": low, "vmax": high, "cmap": cmap, "label": rf"$4\pi t$·HKS, metric {name}"}
            plot.scalar_image(ax, values[i], grid, hatched=near[i], orientation=orientation, **style)
            ax.set_title(f"{length:g} mm\n$t$ = {plot.number_text(t)} {unit}", fontsize="medium")
    for ax in panels[1]:
        ax.set_xlabel("mm", fontsize="small")
    fig.suptitle(
        "Brain slice. Above: the metric is the diffusion tensor $D$, as in the paper; below: $D^{-1}$\n"
        f"4πt·HKS = 1 means flat; heat has spread over {LENGTHS[0]:g} to {LENGTHS[-1]:g} mm; hatched: {RIM_NOTE}",
        fontsize="medium",
    )
    return fig
