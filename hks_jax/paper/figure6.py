"""Figure 6: a slice of a brain at several times, with separate colours for each image."""

from collections.abc import Callable

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure
from scipy.ndimage import distance_transform_edt

from hks_jax import plot
from hks_jax.domain.examples import phantom
from hks_jax.domain.grid import Grid
from hks_jax.domain.tensor_checks import MetricChoice
from hks_jax.domain.tensor_field import TensorField
from hks_jax.io import TensorVolume, erode, find_example_brain, fit_dwi
from hks_jax.paper.signature import enough_pairs, signature
from hks_jax.plot.signature import bounding_box, placed

LENGTHS = (5.0, 10.0, 20.0, 40.0)  # distances of heat flow in mm, √(t / mean diffusivity or its inverse)
SLICE = 0


def make(full: bool, echo: Callable[[str], None]) -> Figure:
    """Return the figure of the brain in the PyPI wheel ``mdt`` if it is installed, otherwise of a phantom."""
    volume, name = _brain(echo), "brain"
    if volume is None:
        tensors, mask, spacing = phantom()
        volume, name = TensorVolume(tensors, spacing, (0.0, 0.0), mask), "phantom"
    assert volume.mask is not None
    box = bounding_box(volume.mask)
    orientation = placed(volume, box, "neurological")
    tensors = volume.tensors[box]
    grid = Grid(tensors.shape[:2], volume.spacing, mask=volume.mask[box], components="largest")
    depth = distance_transform_edt(np.pad(grid.inside, 1), sampling=grid.spacing)[1:-1, 1:-1]
    diffusivity = np.trace(tensors, axis1=-2, axis2=-1) / 2
    typical = float(np.median(diffusivity[grid.inside]))
    rows: dict[MetricChoice, tuple[str, float, str]] = {
        "tensor": ("$T = D$, as in the paper", typical, "mm⁴/s"),
        "inverse": ("$g = D^{-1}$", 1 / typical, "s"),
    }

    colours = colormaps["viridis"].with_extremes(over="0.85")
    fig = plot.new_figure(15.5, 8.6)
    panels = fig.subplots(2, 5, sharex=True, sharey=True)
    plot.scalar_image(panels[0, 0], 1e3 * diffusivity, grid, quantiles=(0.01, 0.99), orientation=orientation)
    panels[0, 0].set_title("mean diffusivity\nin $10^{-3}$ mm²/s", fontsize="medium")
    eigenvalues = np.linalg.eigvalsh(tensors)
    anisotropy = np.ptp(eigenvalues, axis=-1) / np.maximum(eigenvalues.sum(axis=-1), 1e-12)
    plot.scalar_image(panels[1, 0], anisotropy, grid, quantiles=(0.01, 0.99), orientation=orientation)
    panels[1, 0].set_title("anisotropy\n$(λ_1 - λ_2)/(λ_1 + λ_2)$", fontsize="medium")
    for row, (metric, (label, area, unit)) in zip(panels, rows.items(), strict=True):
        field = TensorField.from_diffusion(grid, tensors, metric=metric)
        times = [length**2 * area for length in LENGTHS]
        k = enough_pairs(field, times[0], exponent=10.0 if full else 6.0)
        echo(f"{name}, {label}, {int(grid.inside.sum())} nodes, {k} eigenpairs")
        values = signature(field, times, k)
        for ax, image, t, length in zip(row[1:], values, times, LENGTHS, strict=True):
            # The Neumann boundary raises the HKS near it up to fourfold, so the values in the tissue set the colours.
            tissue = depth > min(2 * length, 0.3 * depth.max())
            low, high = np.quantile(image[tissue], (0.01, 0.99)).tolist()
            plot.scalar_image(ax, image, grid, cmap=colours, vmin=low, vmax=high, orientation=orientation)
            ax.set_title(f"{label}\n$t$ = {plot.number_text(t)} {unit}", fontsize="medium")
        row[0].set_ylabel("mm")
    for ax in panels[1]:
        ax.set_xlabel("mm")
    fig.suptitle(f"Diffusion tensors of a {name} and their HKS, which the Neumann boundary raises (grey: out of range)")
    return fig


def _brain(echo: Callable[[str], None]) -> TensorVolume | None:
    brain = find_example_brain()
    if brain is None:
        echo("no brain is installed (the wheel mdt==1.2.7 contains one), so a phantom is drawn")
        return None
    try:
        volume = fit_dwi(brain.images, brain.bval, brain.bvec, brain.mask, b_max=1100)
    except ImportError as error:
        echo(f"{error}; drawing a phantom")
        return None
    assert volume.mask is not None
    return volume.with_mask(erode(volume.mask, 2)).slice("z", SLICE)
