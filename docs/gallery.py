"""Make docs/gallery.md and its pictures: ``python docs/gallery.py [NAME…]``."""

import inspect
import sys
import textwrap
import warnings
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import hks_jax as hj
from hks_jax import plot
from hks_jax.domain.examples import phantom

HERE = Path(__file__).parent
PICTURES = HERE / "images" / "gallery"
DPI = 72

HEAD = """\
# Gallery

This page shows every picture of `hks_jax.plot`, with a link to the function of [gallery.py](gallery.py) that draws it.
"""

IMPORTS = """\
import jax
import jax.numpy as jnp
import numpy as np

import hks_jax as hj
from hks_jax import plot
from hks_jax.domain.examples import phantom

jax.config.update("jax_enable_x64", True)
"""


def brain_like(shape: tuple[int, int] = (60, 70)) -> hj.TensorField:
    """Return the metric D⁻¹ of an analytic brain phantom."""
    tensors, mask, spacing = phantom(shape)
    return hj.TensorField.from_diffusion(hj.Grid(shape, spacing, mask=mask), tensors, metric="inverse")


def signature_at_dot(field: hj.TensorField) -> jax.Array:
    """Return the HKS at one node and time."""
    return hj.hks(hj.eigenpairs(field, 80, multiplet="drop"), [0.03])[0, 12, 12]


def panels() -> Figure:
    """Each panel shows the signature at one time, with its own range of colours or (`shared_range`) a common one."""
    field = brain_like()
    times = np.array([0.4, 1.5, 6.0]) * 1e5
    values = hj.hks(hj.eigenpairs(field, 300), times)
    # The natural boundary raises the signature up to fourfold; the range of colours excludes these highest values.
    return plot.hks_panels(values, times, field.grid, unit="s", quantiles=(0.01, 0.9), label="HKS in 1/s")


def glyphs() -> Figure:
    """Ellipses show the unit circles of the metric; their colour is the anisotropy or the orientation."""
    field = brain_like()
    figure = plot.new_figure(8.4, 4.2)
    left, right = figure.subplots(1, 2)
    plot.ellipses(left, field, sizes="fit")
    plot.ellipses(right, field, sizes="fit", color="orientation")
    return figure


def lines() -> Figure:
    """Evenly spaced integral lines of the eigenvectors are drawn on an image of the signature."""
    field = hj.examples.figure4_fields(41)["waves"]
    (values,) = hj.hks(hj.eigenpairs(field, 200, "mirror", multiplet="drop"), [0.02], "flat")
    figure = plot.new_figure(4.6, 3.8)
    ax = figure.subplots()
    plot.scalar_image(ax, values, field.grid, label=r"$4\pi t\,$HKS, $t$ = 0.02", interpolation="bilinear")
    plot.integral_lines(ax, field, "major", colors="white", density=0.8)
    plot.integral_lines(ax, field, "minor", colors="tab:orange", density=0.8, linewidths=0.5)
    return figure


def convolution() -> Figure:
    """Line integral convolution shows the eigenvector field at every pixel, alone or as shading of a scalar."""
    field = hj.examples.figure4_fields(41)["cells"]
    (values,) = hj.hks(hj.eigenpairs(field, 200, "mirror", multiplet="drop"), [0.02], "flat")
    figure = plot.new_figure(7.6, 3.6)
    left, right = figure.subplots(1, 2)
    plot.line_integral_convolution(left, field, pixels=220)
    plot.line_integral_convolution(right, field, values=values, pixels=220, label=r"$4\pi t\,$HKS, $t$ = 0.02")
    return figure


def degenerate() -> Figure:
    """At degenerate points the eigenvalues are equal. Each mark shows the index of the eigenvectors around a point."""
    grid = hj.Grid.from_bounds(-1, 1, (61, 61))
    z = grid.nodes[..., 0] + 1j * grid.nodes[..., 1]
    v = (z - 0.5) * (z + 0.4 - 0.3j) * np.conj(z + 0.1 + 0.5j) ** 2 * np.conj(z - 0.2 - 0.6j)
    v = v / (1 + np.abs(v))  # T = 2·I + [[Re v, Im v], [Im v, −Re v]]
    tensors = np.stack([np.stack([2 + v.real, v.imag], -1), np.stack([v.imag, 2 - v.real], -1)], -1)
    field = hj.TensorField(grid, tensors)
    print(hj.degenerate_points(field))
    figure = plot.new_figure(4.0, 4.2)
    ax = figure.subplots()
    plot.integral_lines(ax, field, colors="0.5")
    plot.degenerate_points(ax, field)
    return figure


def curves() -> Figure:
    """Solid curves show HKS(t) at two points; dashed curves show its expansion. Shading marks unresolved times."""
    field = hj.examples.sphere_field(41, 1.5)
    pairs = hj.eigenpairs(field, 150, multiplet="drop")
    times = jnp.geomspace(0.005, 3, 60)
    figure = plot.new_figure(7.6, 3.4)
    limit = float(hj.truncation(pairs, times).smallest_time)
    for ax, scaled in zip(figure.subplots(1, 2), (False, True), strict=True):
        plot.hks_curves(
            ax,
            hj.hks(pairs, times),
            times,
            field.grid,
            [[0, 0], [0.75, 0.75]],
            expansion=hj.hks_expansion(field, times),
            limit=limit,
            scaled=scaled,
        )
    return figure


def weyl() -> Figure:
    """The number of eigenvalues up to λ follows Weyl's law until the grid is too coarse for λ."""
    field = hj.examples.figure4_fields(41)["cells"]
    pairs = hj.eigenpairs(field, 250)
    figure = plot.new_figure(7.6, 3.2)
    counts, remainder = figure.subplots(1, 2)
    plot.spectrum(counts, pairs, field)
    plot.spectrum(remainder, pairs, field, remainder=True)
    return figure


def influence() -> Figure:
    """The maps show the boundary's share of the signature. Contour lines mark shares of 1 % and 10 %."""
    field = brain_like()
    times = np.array([0.4, 1.5, 6.0]) * 1e5
    values = hj.boundary_influence(field, times, 300)
    figure = plot.new_figure(8.4, 3.2)
    for ax, t, image in zip(figure.subplots(1, 3), times, values, strict=True):
        plot.influence_map(ax, image, field.grid)
        ax.set_title(f"$t$ = {plot.number_text(t)} s", fontsize="medium")
    return figure


def around_one() -> Figure:
    """4πt·HKS is 1 where the metric is flat. The upper row shows the effect of a mask's rim; the lower row lacks it."""
    field = brain_like()
    times = np.array([0.4, 1.5, 6.0]) * 1e5
    pairs = hj.eigenpairs(field, 600, "mean")
    mean = hj.hks(pairs, times, "flat")
    natural = mean * (1 + hj.boundary_influence(pairs, times))
    figure = plot.new_figure(8.4, 6.2)
    for row, name, values in zip(figure.subplots(2, 3), ("neumann", "mean"), (natural, mean), strict=True):
        for ax, t, image in zip(row, times, values, strict=True):
            plot.scalar_image(ax, image, field.grid, vmin=0.6, vmax=1.4, centre=1.0)
            ax.set_title(f"{name}, $t$ = {plot.number_text(t)} s", fontsize="medium")
            ax.set_axis_off()
    return figure


def ball() -> Figure:
    """In (4πt)^(3/2)·HKS of a ball, Neumann conditions hide two inclusions, which the boundary "mean" shows."""
    n = 24
    grid = hj.Grid((n, n, n), 2 / (n - 1), -1.0)
    x, y, z = np.moveaxis(grid.nodes, -1, 0)
    grid = hj.Grid(grid.shape, grid.spacing, -1.0, mask=x**2 + y**2 + z**2 < 0.95)
    hill, basin = (np.exp(-((x - a) ** 2 + y**2 + z**2) / 0.06) for a in (-0.35, 0.35))
    field = hj.TensorField(grid, (1 + 1.5 * hill - 0.5 * basin)[..., None, None] * np.eye(3))
    times = np.array([0.05, 0.12])
    pairs = hj.eigenpairs(field, 300, "mean", multiplet="drop")
    mean = hj.hks(pairs, times, "flat")
    natural = mean * (1 + hj.boundary_influence(pairs, times))
    return plot.volume_panels(
        np.concatenate([natural, mean]),
        np.tile(times, 2),
        grid,
        node=(n // 2,) * 3,
        titles=[f"{name}, t = {t:g}" for name in ("neumann", "mean") for t in times],
        limits=[(0.4, 1.6)] * 4,
        cmap="RdBu_r",
    )


def rim_errors() -> Figure:
    """The curves show the error at the rim of flat domains for Neumann and Dirichlet signatures and for their mean."""
    n = 41
    x, y = np.meshgrid(*[np.linspace(-1, 1, n)] * 2, indexing="ij")
    radius = np.hypot(x, y)
    domains = {
        "disc": (radius <= 0.9, "mean"),
        "annulus": ((radius <= 0.95) & (radius >= 0.35), "mean"),
        "ellipse": ((x / 0.95) ** 2 + (y / 0.6) ** 2 <= 1, "mean"),
        "half a square, periodic in y": (x <= 0, ("mean", "periodic")),
    }
    times = np.linspace(0.075, 0.4, 14) ** 2
    figure = plot.new_figure(9.6, 2.8)
    for ax, (name, (mask, boundary)) in zip(figure.subplots(1, 4, sharey=True), domains.items(), strict=True):
        grid = hj.Grid((n, n), 2 / (n - 1), -1.0, mask=mask)
        pairs = hj.eigenpairs(hj.TensorField(grid, np.broadcast_to(np.eye(2), (n, n, 2, 2))), 350, boundary)
        mean, influence = hj.hks(pairs, times, "flat"), hj.boundary_influence(pairs, times)
        rim = pairs.space.domain & ~pairs.pencil.parts[1].space.free
        curves = {"neumann": mean * (1 + influence), "dirichlet": mean * (1 - influence), "mean": mean}
        for (label, values), style in zip(curves.items(), ("C3-", "C0-", "k-"), strict=True):
            ax.plot(np.sqrt(times), np.sqrt(np.mean((values[:, rim] - 1) ** 2, axis=1)), style, label=label)
        if name == "disc":
            ax.plot(np.sqrt(times), np.sqrt(np.pi * times) / 4 / 0.9, "k:", label=r"$\sqrt{\pi t}\,/\,4R$")
        ax.set_title(name, fontsize="medium")
        ax.set_xlabel(r"$\sqrt{t}$")
    figure.axes[0].set_ylabel(r"rms of $4\pi t\,$HKS − 1 on the rim")
    figure.axes[3].legend(handles=figure.axes[0].lines, loc="center right", fontsize="small")
    return figure


def rows() -> Figure:
    """The rows show the signature, and trace and anisotropy smoothed by Gaussians or by heat flow in the metric."""
    field = hj.examples.figure3_fields(41)["T³"]
    pairs = hj.eigenpairs(field, 200, "mirror", multiplet="drop")
    times = np.array([1.0, 4.0, 16.0])
    scalars = hj.tensor_invariants(field)
    values = {"HKS": hj.hks(pairs, times, "flat")}
    for name in ("trace", "anisotropy"):
        values[f"{name}\nGaussian"] = hj.gaussian_scale_space(field, times, scalars[name])
        values[f"{name}\nheat flow"] = hj.heat_flow(pairs, times, scalars[name])
    return plot.time_rows(values, times, field.grid)


def derivative() -> Figure:
    """The bars show the derivative of the signature at the black dot with respect to every tensor."""
    field = hj.examples.figure4_fields(24)["waves"]
    derivative_of = jax.grad(lambda tensors: signature_at_dot(hj.TensorField(field.grid, tensors)))
    gradient = derivative_of(field.tensors)
    figure = plot.new_figure(4.0, 3.8)
    ax = figure.subplots()
    plot.sensitivity(ax, field.grid, gradient, every=1)
    ax.plot(*field.grid.nodes[12, 12], "ko", markersize=4)
    return figure


def fit() -> Figure:
    """The panels show target, fit and difference at two times, the fitted metric, and the loss of each step."""
    grid = hj.Grid(shape=(20, 20), spacing=1 / 19)
    x, y = grid.nodes[..., 0], grid.nodes[..., 1]
    hidden = hj.TensorField(grid, jnp.exp(0.4 * jnp.sin(3 * x) * jnp.cos(2 * y))[..., None, None] * jnp.eye(2))
    times = jnp.geomspace(0.01, 0.1, 4)
    target = hj.hks(hj.eigenpairs(hidden, k=400), times)
    return plot.fit_panels(hj.fit_metric(grid, target, times, "conformal"), target, times, max_times=2)


def volume() -> Figure:
    """On three orthogonal slices, small times show a narrow maximum of the metric, and large times a wide one."""
    n = 20
    grid = hj.Grid((n, n, n), 2 / n, -1.0)
    factor = np.ones(grid.shape)
    for centre, sharpness in (([0.5, 0.4, 0.0], 6), ([-0.4, -0.4, 0.0], 1)):
        factor += 3 * np.exp(sharpness * np.sum(np.cos(np.pi * (grid.nodes - centre)) - 1, axis=-1))
    field = hj.TensorField(grid, factor[..., None, None] * np.eye(3))
    pairs = hj.eigenpairs(field, 200, "periodic", "shift-invert", multiplet="drop")  # no side, no boundary effect
    times = [0.06, 0.2, 0.6]
    return plot.volume_panels(hj.hks(pairs, times), times, grid, node=(15, 14, 10))


def surfaces() -> Figure:
    """PyVista renders isosurfaces of a volume (`pip install "hks-jax[pyvista]"`)."""
    n = 24
    grid = hj.Grid((n, n, n), 2 / n, -1.0)
    x, y, z = np.moveaxis(np.pi * grid.nodes, -1, 0)
    factor = np.exp(0.8 * (np.sin(x) * np.cos(y) + np.sin(y) * np.cos(z) + np.sin(z) * np.cos(x)))
    field = hj.TensorField(grid, factor[..., None, None] * np.eye(3))
    (values,) = hj.hks(hj.eigenpairs(field, 120, "periodic", multiplet="drop"), [0.2])
    figure = plot.new_figure(4.8, 3.8)
    ax = figure.subplots()
    mappable = plot.isosurfaces(ax, values, grid, levels=2, opacity=0.6)
    figure.colorbar(mappable, ax=ax, label="HKS at $t$ = 0.2", shrink=0.7)
    return figure


def torus() -> Figure:
    """The colour of a surface shows its signature."""
    mesh = hj.examples.bumpy_torus_mesh(90)
    (values,) = hj.hks(hj.eigenpairs(mesh, 60, multiplet="drop"), [1.0])
    figure = plot.new_figure(5.0, 3.4)
    ax = figure.add_subplot(projection="3d")
    mappable = plot.surface(ax, mesh, values)
    figure.colorbar(mappable, ax=ax, label="HKS at $t$ = 1", shrink=0.7)
    return figure


def solid() -> Figure:
    """The colour shows the signature on half of a tetrahedral ball. Diffusion is fast along helices about its axis."""
    ball = hj.examples.ball_mesh(11)
    x, y, z = np.asarray(ball.vertices).T
    along = np.stack([-y, x, 0.4 + 0 * z], axis=-1)
    D = 0.1 * np.eye(3) + along[:, :, None] * along[:, None, :]
    mesh = hj.TetMesh.from_tensors(ball.vertices, ball.cells, D, "inverse")
    (values,) = hj.hks(hj.eigenpairs(mesh, 100, multiplet="drop"), [0.3])
    behind = ball.cells[y[ball.cells].mean(axis=1) > 0]
    numbers, cells = np.unique(behind, return_inverse=True)
    half = hj.TetMesh(ball.vertices[numbers], cells.reshape(-1, 4))
    figure = plot.new_figure(5.0, 3.4)
    ax = figure.add_subplot(projection="3d", azim=-75, elev=15)
    mappable = plot.surface(ax, half, values[numbers])
    figure.colorbar(mappable, ax=ax, label="HKS at $t$ = 0.3", shrink=0.7)
    return figure


ENTRIES: dict[str, Callable[[], Figure]] = {
    "Signatures over t": panels,
    "Tensor ellipses": glyphs,
    "Integral lines": lines,
    "Line integral convolution": convolution,
    "Degenerate points": degenerate,
    "Curves at points": curves,
    "Spectra and Weyl's law": weyl,
    "The boundary's influence": influence,
    "Around 1, without the rim": around_one,
    "Around 1, in a volume": ball,
    "Errors at a rim": rim_errors,
    "Smoothing and heat flow": rows,
    "Volumes": volume,
    "Isosurfaces": surfaces,
    "Sensitivity": derivative,
    "Fits": fit,
    "Surfaces": torus,
    "Solids": solid,
}


def code(name: str) -> str:
    """Return the code of one picture as the site shows it; ``before`` is the code that all pictures share."""
    if name == "before":
        helpers = "\n\n".join(inspect.getsource(helper) for helper in (brain_like, signature_at_dot))
        return f"All code below begins with\n\n```python\n{IMPORTS}\n\n{helpers}```"
    (draw,) = (draw for draw in ENTRIES.values() if draw.__name__ == name)
    body = textwrap.dedent(inspect.getsource(draw).split('"""', 2)[2]).strip("\n")
    body = body.replace("return figure", 'plot.save_figure(figure, "picture.png")')
    body = body.replace("return plot", "figure = plot")
    return f"```python\n{body}\n```"


def page() -> str:
    """Return the text of docs/gallery.md. The build puts the code in place of the comments."""
    parts = [HEAD, "<!-- gallery: before -->"]
    for title, draw in ENTRIES.items():
        image = f"![{title}](images/gallery/{draw.__name__}.png)"
        text = f"{draw.__doc__} ([{draw.__name__}](gallery.py))"
        parts += [f"## {title}", text, image, f"<!-- gallery: {draw.__name__} -->"]
    return "\n\n".join(part.rstrip() for part in parts) + "\n"


def main(names: list[str]) -> None:
    """Draw the named pictures, or all if none is named, and write the page."""
    jax.config.update("jax_enable_x64", True)
    for draw in ENTRIES.values():
        if names and draw.__name__ not in names:
            continue
        with warnings.catch_warnings():
            # k cuts a multiple eigenvalue of the symmetric fields, without effect on a picture. The curves include
            # unresolved times on purpose.
            warnings.filterwarnings("ignore", ".*(multiple eigenvalue|too small for k)", hj.AccuracyWarning)
            path = plot.save_figure(draw(), PICTURES / f"{draw.__name__}.png", dpi=DPI)
        print(path, path.stat().st_size // 1024, "KiB", flush=True)
    (HERE / "gallery.md").write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
