"""Compare a brain slice's signatures of the metric D⁻¹ and of Fick's operator (docs/choices.md).

    python notebooks/brains/brain_operators.py [-k 300] [-o docs/images]

The brain is that of ``hks-jax demo``: it takes the wheel mdt==1.2.7 and DIPY.
"""

import argparse
from pathlib import Path

import jax
import numpy as np

import hks_jax as hj

LENGTHS = np.array([5.0, 10.0, 20.0, 40.0])
"""√(Dt), mm."""


def main() -> None:
    """Compute both, print a table, draw both."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-k", type=int, default=300, help="eigenpairs of either boundary problem")
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/images"))
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    brain = hj.io.find_example_brain()
    if brain is None:
        raise SystemExit("the wheel mdt==1.2.7 is not installed")
    volume = hj.io.fit_dwi(brain.images, brain.bval, brain.bvec, brain.mask, b_max=1000.0)
    plane = volume.slice("z", 0)
    plane = plane.with_mask(hj.io.erode(plane.mask, 2))
    grid, D = plane.grid("largest"), np.asarray(plane.tensors, float)
    times = LENGTHS**2 / np.median(np.trace(D, axis1=-2, axis2=-1)[plane.mask] / 2)
    maps, labels = [], (r"$4\pi t\,$HKS, metric D⁻¹", r"$4\pi t\sqrt{|D|}\,$HKS, Fick")
    for choice in ({"metric": "inverse"}, {"operator": "fick"}):
        field = hj.TensorField.from_diffusion(grid, D, **choice)
        pairs = hj.eigenpairs(field, 2 * args.k, "mean", multiplet="drop")
        maps.append(np.asarray(hj.hks(pairs, times, "flat")))
    inside = np.isfinite(maps[0][0])
    root = np.sqrt(np.linalg.det(D[inside]))
    for length, one, other in zip(LENGTHS, *maps, strict=True):
        one, other = one[inside], other[inside]
        ranges = ["{:.2f} to {:.2f}".format(*np.percentile(each, [2, 98])) for each in (one, other, other / root)]
        median, of_root = np.median(np.abs(other - one)), np.corrcoef(np.log(other), np.log(root))[0, 1]
        relation = np.corrcoef(one, other)[0, 1]
        unit = np.median(other / root)
        raw = "{:.2f} to {:.2f}".format(*np.percentile(other / root / unit, [2, 98]))
        print(f"| {length:g} mm | {ranges[0]} | {ranges[1]} | {median:.2f} | {relation:.2f} | {of_root:.2f} | {raw} |")
    print("√|D| relative to its median:", np.percentile(root, [2, 98]) / np.median(root))
    fast = root > np.quantile(root, 0.9)
    print(f"heat in the fastest tenth at the end: {np.sum(1 / root[fast]) / np.sum(1 / root):.1%} of D⁻¹")
    figure = hj.plot.new_figure(8.4, 7.4)
    orientation = hj.plot.Orientation.of(plane.volume_affine, plane.thin_axis)
    shown = orientation.grid(grid)
    nodes = np.argwhere(orientation.array(inside)) * shown.spacing + shown.origin
    (left, bottom), (right, top) = nodes.min(axis=0) - 4, nodes.max(axis=0) + 4
    for row, name, values in zip(figure.subplots(2, 3), labels, maps, strict=True):
        for ax, length, image in zip(row, LENGTHS, values, strict=False):
            colours = {"vmin": 0.5, "vmax": 1.5, "cmap": "RdBu_r", "label": name}
            hj.plot.scalar_image(ax, image, grid, orientation=orientation, **colours)
            ax.set_title(rf"$\sqrt{{Dt}}$ = {length:g} mm", fontsize="medium")
            ax.set(xlim=(left, right), ylim=(bottom, top))
            ax.set_axis_off()
    hj.plot.save_figure(figure, args.output / "brain_operators.png", dpi=80)


if __name__ == "__main__":
    main()
