"""Draw a brain slice's signature around 1, with natural conditions on the rim and with the mean (docs/choices.md).

    python notebooks/brains/brain_rim.py [-k 300] [-o docs/images]

The brain is that of ``hks-jax demo``: it takes the wheel mdt==1.2.7 and DIPY.
"""

import argparse
from pathlib import Path

import jax
import numpy as np

import hks_jax as hj

LENGTHS = np.array([5.0, 10.0, 20.0])
"""√(Dt), mm."""


def main() -> None:
    """Compute both, draw both."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-k", type=int, default=300, help="eigenpairs of either problem")
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/images"))
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    brain = hj.io.find_example_brain()
    if brain is None:
        raise SystemExit("the wheel mdt==1.2.7 is not installed")
    volume = hj.io.fit_dwi(brain.images, brain.bval, brain.bvec, brain.mask, b_max=1000.0)
    plane = volume.slice("z", 0)
    plane = plane.with_mask(hj.io.erode(plane.mask, 2))
    grid = plane.grid("largest")
    field = hj.TensorField.from_diffusion(grid, np.asarray(plane.tensors, float), "inverse")
    times = LENGTHS**2 / np.median(np.trace(plane.tensors, axis1=-2, axis2=-1)[plane.mask] / 2)

    pairs = hj.eigenpairs(field, 2 * args.k, "mean", multiplet="drop")
    mean = np.asarray(hj.hks(pairs, times, "flat"))
    natural = mean * (1 + np.asarray(hj.boundary_influence(pairs, times)))
    figure = hj.plot.new_figure(8.4, 7.4)
    orientation = hj.plot.Orientation.of(plane.volume_affine, plane.thin_axis)
    shown = orientation.grid(grid)
    nodes = np.argwhere(np.isfinite(orientation.array(mean)[0])) * shown.spacing + shown.origin
    (left, bottom), (right, top) = nodes.min(axis=0) - 4, nodes.max(axis=0) + 4
    for row, name, values in zip(figure.subplots(2, 3), ("neumann", "mean"), (natural, mean), strict=True):
        for ax, length, image in zip(row, LENGTHS, values, strict=True):
            ax.set(xlim=(left, right), ylim=(bottom, top))
            colours = {"vmin": 0.7, "vmax": 1.3, "cmap": "RdBu_r", "label": r"$4\pi t\,$HKS"}
            hj.plot.scalar_image(ax, image, grid, orientation=orientation, **colours)
            ax.set_title(rf"{name}, $\sqrt{{Dt}}$ = {length:g} mm", fontsize="medium")
            ax.set(xlim=(left, right), ylim=(bottom, top))
            ax.set_axis_off()
            low, middle, high = np.nanpercentile(image, [2, 50, 98])
            print(f"{name}, {length:g} mm: {low:.2f} … {middle:.2f} … {high:.2f}")
    hj.plot.save_figure(figure, args.output / "brain_rim.png", dpi=90)


if __name__ == "__main__":
    main()
