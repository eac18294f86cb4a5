"""A study of public brains: from tensors and scans to one table of regions, for two boundaries (docs/studies.md).

    python notebooks/brains/brain_study.py BRAINS [-o brains]

BRAINS is a folder with what there is of brain_tensor.nii.gz and brain_mask.nii.gz (tensors and their mask) and of
brain_dwi.nii.gz, .bval and .bvec (a scan); the brain of ``hks-jax demo`` joins them where the wheel mdt==1.2.7 is
installed. A slice of each is computed. The regions are tissues by their diffusivity and anisotropy, and grey matter by
its distance to the rim; a study of yours has an atlas instead.
"""

import argparse
import csv
from pathlib import Path

import nibabel as nib
import numpy as np
from scipy import ndimage

import hks_jax as hj
from hks_jax.cli import main as hks_jax

REGIONS = {1: "grey matter within 8 mm of the rim", 2: "grey matter further inside", 3: "white matter", 4: "fluid"}
TIMES = ("6e4", "1.2e5", "2.5e5", "5e5")
"""Seconds: heat in grey matter has spread √(Dt) = 7, 10, 14 and 20 mm then."""


def tissues(volume: hj.io.TensorVolume) -> np.ndarray:
    """Return the regions' numbers at the voxels of a volume."""
    values = np.where(volume.inside[..., None], np.linalg.eigvalsh(volume.tensors), 1e-9)
    mean = values.mean(axis=-1)
    spread = np.square(values - mean[..., None]).sum(axis=-1) / np.square(values).sum(axis=-1)
    depth = np.stack(
        [ndimage.distance_transform_edt(inside, volume.spacing[:2]) for inside in np.moveaxis(volume.inside, 2, 0)], 2
    )
    labels = np.where(depth < 8, 1, 2)
    labels[np.sqrt(1.5 * spread) > 0.3] = 3
    labels[mean > 1.5e-3] = 4
    return np.where(volume.inside, labels, 0).astype(np.int16)


def brains(folder: Path) -> list[tuple[hj.io.TensorVolume, dict[str, str | Path]]]:
    """Return the volumes that there are, and the rows of the study's table that say how they are read."""
    found = []
    tensors, mask = folder / "brain_tensor.nii.gz", folder / "brain_mask.nii.gz"
    if tensors.exists():
        row = {"file": tensors, "mask": mask, "slice": "z=14"}
        found.append((hj.io.read_tensors(tensors, mask=mask), row))
    images = folder / "brain_dwi.nii.gz"
    if images.exists():
        bval, bvec = folder / "brain_dwi.bval", folder / "brain_dwi.bvec"
        row = {"file": images, "bval": bval, "bvec": bvec, "slice": "z=11", "erode": "2"}
        found.append((hj.io.fit_dwi(images, bval, bvec), row))
    brain = hj.io.find_example_brain()
    if brain is not None:
        row = {"file": brain.images, "bval": brain.bval, "bvec": brain.bvec, "mask": brain.mask}
        row |= {"slice": "z=0", "erode": "2", "b_max": "1000"}
        found.append((hj.io.fit_dwi(brain.images, brain.bval, brain.bvec, brain.mask, b_max=1000.0), row))
    return found


def write_study(folder: Path, out: Path) -> Path:
    """Write the table of subjects and their atlases; return the table's path."""
    out.mkdir(parents=True, exist_ok=True)
    rows = []
    for number, (volume, row) in enumerate(brains(folder), 1):
        atlas = out / f"sub-{number:02d}_dseg.nii.gz"
        nib.save(nib.Nifti1Image(tissues(volume), volume.affine), atlas)
        rows.append({"participant_id": f"sub-{number:02d}", **row, "atlas": atlas})
    (out / "names.tsv").write_text("index\tname\n" + "".join(f"{i}\t{name}\n" for i, name in REGIONS.items()))
    columns = ["participant_id", "file", "mask", "bval", "bvec", "slice", "erode", "b_max", "atlas"]
    with open(out / "subjects.tsv", "w", newline="") as stream:
        writer = csv.DictWriter(stream, columns, restval="n/a", delimiter="\t")
        writer.writeheader()
        for row in rows:
            paths = {name: value.resolve() for name, value in row.items() if isinstance(value, Path)}
            writer.writerow({**row, **paths})
    return out / "subjects.tsv"


def main() -> None:
    """Compute with both boundaries, and print the regions' means."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("brains", type=Path)
    parser.add_argument("-o", "--output", type=Path, default=Path("brains"))
    args = parser.parse_args()
    table, found = write_study(args.brains, args.output), {}
    for boundary, k in (("neumann", 200), ("mean", 400)):
        study = args.output / boundary
        words = ["batch", table, "-o", study, "--metric", "inverse", "--boundary", boundary, "-k", k]
        words += ["--normalisation", "flat", "--components", "largest", "--times", *TIMES]
        hks_jax([*map(str, words), "--names", str(args.output / "names.tsv")])
        with open(study / "group_regions.tsv") as stream:
            for row in csv.DictReader(stream, delimiter="\t"):
                key = row["region"], float(row["t"])
                found.setdefault(key, {}).setdefault(boundary, []).append((float(row["mean"]), float(row["std"])))
    for (region, t), values in found.items():
        cells = [", ".join(f"{m:.2f} ± {s:.2f}" for m, s in values[boundary]) for boundary in values]
        print(f"| {region} | {t:.2g} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
