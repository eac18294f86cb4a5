"""Draw a brain's signature in the whole volume, and one slice of it beside the slice alone (docs/volumes.md).

    python notebooks/brains/brain_volume.py TENSORS MASK [--slice 14] [-k 100] [-o docs/images]

TENSORS and MASK are NIfTI files of diffusion tensors, mm²/s, and of the brain.
"""

import argparse
import time
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import hks_jax as hj

TIMES = (2e5, 4e5, 1e6)  # s


def signature(volume: hj.io.TensorVolume, k: int) -> tuple[hj.Grid, np.ndarray]:
    """Return the grid and the signature of a volume or a slice, g = D⁻¹."""
    grid = volume.grid(components="largest")
    field = hj.TensorField.from_diffusion(grid, np.asarray(volume.tensors, float), metric="inverse")
    start = time.perf_counter()
    pairs = hj.eigenpairs(field, k, multiplet="drop")
    print(f"{pairs.summary()}\n{time.perf_counter() - start:.0f} s", flush=True)
    return grid, np.asarray(hj.hks(pairs, TIMES))


def main() -> None:
    """Compute both, draw both."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("tensors")
    parser.add_argument("mask")
    parser.add_argument("--slice", type=int, default=14, metavar="Z")
    parser.add_argument("-k", type=int, default=100)
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/images"))
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    warnings.simplefilter("ignore", hj.AccuracyWarning)
    volume = hj.io.read_tensors(args.tensors).with_mask(hj.io.read_mask(args.mask))
    z = args.slice

    grid, whole = signature(volume, args.k)
    titles = [f"t = {t:.0e} s".replace("e+0", "e") for t in TIMES]
    middle = hj.plot.middle_node(np.asarray(grid.mask))
    orientation = hj.plot.Orientation.of(volume.affine)
    hj.plot.volume_panels(
        whole,
        TIMES,
        grid,
        node=(*middle[:2], z),
        titles=titles,
        length_unit="mm",
        quantiles=(0.02, 0.93),
        orientation=orientation,
        path=args.output / "brain_volume.png",
    )

    plane, alone = signature(volume.slice("z", z), 2 * args.k)
    orientation = hj.plot.Orientation.of(volume.affine, 2)
    turned = orientation.grid(plane)
    ends = [(turned.nodes[turned.mask][:, a].min() - 3, turned.nodes[turned.mask][:, a].max() + 3) for a in (0, 1)]
    colours = {"quantiles": (0.02, 0.98), "orientation": orientation}
    figure = plt.figure(figsize=(3.4 * len(TIMES), 7.6))
    figure.set_layout_engine("constrained", w_pad=0.15)
    for column, (pair, title) in enumerate(zip(zip(alone, whole[..., z], strict=True), titles, strict=True)):
        logarithms = [np.log(np.where(plane.mask, image, np.nan)) for image in pair]
        correlation = np.corrcoef(*[image[np.asarray(plane.mask)] for image in logarithms])[0, 1]
        print(f"{title}: correlation of the logarithms {correlation:.3f}")
        for row, (image, of) in enumerate(zip(pair, ("slice alone", "in the volume"), strict=True)):
            ax = figure.add_subplot(2, len(TIMES), 1 + column + row * len(TIMES))
            hj.plot.scalar_image(ax, jnp.asarray(np.where(plane.mask, image, np.nan)), plane, **colours)
            ax.set(title=f"{of}, {title}", xlim=ends[0], ylim=ends[1])
            ax.axis("off")
    hj.plot.save_figure(figure, args.output / "brain_slices.png")


if __name__ == "__main__":
    main()
