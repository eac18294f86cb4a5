"""Test and retest on one brain: the halves of a scan, their difference, and what error bars predict of it.

    python notebooks/brains/brain_noise.py [-o brain-noise]

The brain is the one of ``hks-jax demo`` (the wheel mdt==1.2.7): 13 images without weighting and 30 directions at
b = 1000 s/mm². Every second image makes one half, the others make the other (docs/error-bars.md). Writes halves.json,
with the numbers of the tables, and the picture.
"""

import argparse
import json
import tempfile
from pathlib import Path

import jax
import nibabel as nib
import numpy as np
from brain_study import tissues
from scipy.special import fdtri

import hks_jax as hj
from hks_jax.plot.signature import cropped, placed
from hks_jax.signatures.times import FREE

jax.config.update("jax_enable_x64", True)

LENGTHS = 2.0 ** np.arange(1.0, 4.0, 0.5)
"""√(Dt) in voxels, D the median mean diffusivity of the slice."""
REGIONS = {"all": (1, 2, 3, 4), "grey matter": (1, 2), "white matter": (3,)}
SETTINGS = {"k": 400, "boundary": "mean"}
DRAWS = 16


def fits(folder: Path) -> list[hj.io.TensorVolume]:
    """Return the tensors of the whole scan and of its halves, with their covariances."""
    brain = hj.io.find_example_brain()
    if brain is None:
        raise SystemExit('the example brain is not installed: pip install --no-deps "mdt==1.2.7"')
    images, b, u = nib.load(brain.images), np.loadtxt(brain.bval), np.loadtxt(brain.bvec)
    u = u if u.shape[0] == 3 else u.T
    kept = np.flatnonzero(b <= 1000)
    order = kept[np.argsort(b[kept] > 50, kind="stable")]  # each half takes every second of either kind
    found = []
    for name, chosen in (("whole", order), ("first", order[::2]), ("second", order[1::2])):
        path = folder / f"{name}.nii.gz"
        nib.save(nib.Nifti1Image(np.asarray(images.dataobj)[..., chosen], images.affine), path)
        np.savetxt(folder / f"{name}.bval", b[chosen][None])
        np.savetxt(folder / f"{name}.bvec", u[:, chosen])
        pair = (folder / f"{name}.bval", folder / f"{name}.bvec")
        volume = hj.io.fit_dwi(path, *pair, brain.mask, noise="residuals")
        found.append(volume.with_mask(hj.io.erode(volume.mask, 2)))
    return found


def scalars(plane: hj.io.TensorVolume, volume: hj.io.TensorVolume, z: int, grid: hj.Grid) -> dict[str, np.ndarray]:
    """Return what the signature is compared with: FA and MD of tensors in space, curvature of the slice's metric."""
    values = np.linalg.eigvalsh(volume.tensors[:, :, z])
    mean = values.mean(axis=-1)
    anisotropy = np.sqrt(1.5 * np.sum((values - mean[..., None]) ** 2, -1) / np.sum(values**2, -1).clip(1e-30))
    field = hj.TensorField.from_diffusion(grid, plane.tensors, "inverse")
    return {"FA": anisotropy, "MD": mean, "curvature": np.asarray(hj.gaussian_curvature(field))}


def correlation(a: np.ndarray, b: np.ndarray, where: np.ndarray) -> float:
    """Return the correlation over nodes at which both are known."""
    where = where & np.isfinite(a) & np.isfinite(b)
    return float(np.corrcoef(a[where], b[where])[0, 1])


def maps(
    signature, tensors: np.ndarray, noise: hj.TensorNoise, draws: int = DRAWS
) -> tuple[hj.Uncertainty, np.ndarray]:
    """Return error bars, and the samples of noise of which they are made."""
    samples: list[np.ndarray] = []
    settings = {"draws": draws, "method": "resample", "progress": print}
    bars = hj.uncertainty(signature, tensors, noise, **settings, each=lambda one: samples.append(np.asarray(one)))
    print(bars.summary())
    return bars, np.stack(samples)


def variance_ratio(apart: np.ndarray, predicted: np.ndarray, freedom: float) -> np.ndarray:
    """Return the variance of differences (n_times, n) over the predicted one, by the median over the nodes.

    The median, since the mean over nodes is that of the few noisiest.
    """
    share = (apart - apart.mean(axis=-1, keepdims=True)) ** 2 / predicted
    return np.median(share, axis=-1) / fdtri(1, freedom, 0.5)


def ratios(halves: list[tuple[hj.Uncertainty, np.ndarray]], known: np.ndarray) -> dict[str, np.ndarray]:
    """Return the ratio of the halves' difference, and the range that it has by chance where the prediction is right.

    The latter is that of differences of two samples of noise, predicted by the other samples: 5th to 95th percentile.
    """
    (first, a), (second, b) = halves
    a, b = a[:, :, known], b[:, :, known]
    apart = np.asarray(first.value - second.value)[:, known]
    predicted = np.asarray(first.deviation**2 + second.deviation**2)[:, known]
    n = len(a)
    left = [(np.sum(each**2, axis=0) - each**2) / (n - 1) for each in (a, b)]
    chance = [variance_ratio(a[i] - b[j], left[0][i] + left[1][j], 2 * n - 2) for i in range(n) for j in range(n)]
    low, high = np.quantile(chance, [0.05, 0.95], axis=0)
    ratio = variance_ratio(apart, predicted, first.freedom + second.freedom)
    return {"variance_ratio": ratio, "by_chance_from": low, "by_chance_to": high}


def study(volumes: list[hj.io.TensorVolume], z: int) -> tuple[dict, dict]:
    """Return the numbers of one slice, and what the picture shows."""
    labels = tissues(volumes[0])[:, :, z]
    planes = [hj.io.repair_tensors(each.slice("z", z), "nearest", 1e-4) for each in volumes]
    inside = np.logical_and.reduce([each.mask for each in planes])
    planes = [each.with_mask(inside) for each in planes]
    grid = planes[0].grid("largest")
    labels = np.where(grid.inside, labels, 0)
    diffusivity = float(np.median(np.trace(planes[0].tensors, axis1=-2, axis2=-1)[grid.inside])) / 2
    times = (LENGTHS * planes[0].spacing[0]) ** 2 / diffusivity

    @jax.jit
    def signature(D):
        field = hj.TensorField.from_diffusion(grid, D, "inverse")
        return hj.hks(hj.eigenpairs(field, **SETTINGS), times, "flat")

    width = hj.TensorNoise.from_scans(planes[1].tensors, planes[2].tensors, grid).correlation
    found = [maps(signature, plane.tensors, plane.noise(grid)) for plane in planes]
    bars = [each for each, _ in found]
    whole, first, second = bars
    known = np.isfinite(np.asarray(whole.value[0])) & grid.inside
    near = [maps(signature, p.tensors, hj.TensorNoise(p.covariance, grid, width), 8) for p in planes[1:]]
    judged, shared_nearby = ratios(found[1:], known), ratios(near, known)
    others = [scalars(plane, volume, z, grid) for plane, volume in zip(planes[1:], volumes[1:], strict=True)]
    rows = []
    for i, (t, length) in enumerate(zip(times, LENGTHS, strict=True)):
        row = {"t_s": float(t), "voxels": float(length), "signal_to_noise": float(whole.signal_to_noise[i])}
        row |= {name: float(each[i]) for name, each in judged.items()}
        row |= {f"{name}_shared_by_neighbours": float(each[i]) for name, each in shared_nearby.items()}
        row["claimed"] = bool(whole.trusted[i])
        for region, numbers in REGIONS.items():
            there = known & np.isin(labels, numbers)
            row[region] = correlation(np.asarray(first.value[i]), np.asarray(second.value[i]), there)
        rows.append(row)
    table = {
        name: {
            region: correlation(others[0][name], others[1][name], known & np.isin(labels, numbers))
            for region, numbers in REGIONS.items()
        }
        for name in others[0]
    }
    numbers = {
        "slice": z,
        "nodes": int(known.sum()),
        "correlation_length_mm": width,
        "diffusivity": diffusivity,
        "hks": rows,
        "others": table,
    }
    pairs = hj.eigenpairs(hj.TensorField.from_diffusion(grid, planes[0].tensors, "inverse"), **SETTINGS)
    near = np.asarray(hj.boundary_influence(pairs, times)) >= FREE
    return numbers, {"grid": grid, "bars": bars, "near": near, "plane": planes[0]}


def draw(path: Path, grid: hj.Grid, bars: list[hj.Uncertainty], near: np.ndarray, plane: hj.io.TensorVolume) -> None:
    """Draw both halves without fading, and below the whole with it; hatch the nodes near the boundary."""
    first, second = bars[1:]
    shown, chosen = bars[0], [0, 1, 3, 5]
    figure = hj.plot.new_figure(12, 10.2)
    panels = figure.subplots(3, len(chosen), squeeze=False)
    small, box = cropped(plane, grid.inside)
    orientation = placed(plane, box, "neurological")
    names = ("first half", "second half", "whole, noise faded")
    for line, name, each in zip(panels, names, (first, second, shown), strict=True):
        for ax, i in zip(line, chosen, strict=True):
            value = np.asarray(shown.value[i])
            reach = float(np.nanquantile(np.abs(value - 1), 0.97))
            z = np.asarray(shown.z()[i])[box] if each is shown else None
            style = {"vmin": 1 - reach, "vmax": 1 + reach, "cmap": "RdBu_r", "orientation": orientation}
            hj.plot.scalar_image(ax, np.asarray(each.value[i])[box], small, z=z, hatched=near[i][box], **style)
            ax.set_title(rf"{name}, $\sqrt{{Dt}}$ = {LENGTHS[i]:.2g} voxels", fontsize="small")
            ax.set_axis_off()
    hj.plot.save_figure(figure, path)


def main() -> None:
    """Compute both slices, and draw one."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, default=Path("brain-noise"))
    args = parser.parse_args()
    args.output.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        volumes = fits(Path(folder))
    found = []
    for z in (0, 1):
        numbers, shown = study(volumes, z)
        found.append(numbers)
        (args.output / "halves.json").write_text(json.dumps(found, indent=2) + "\n")
        if z == 0:
            draw(args.output / "error_bars.png", **shown)


if __name__ == "__main__":
    main()
