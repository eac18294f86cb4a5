"""Compare eigenvalues with Weyl's law.

Compute the lowest eigenvalues of the Laplace-Beltrami operator, or of Fick's operator, of a field of diffusion
tensors. FILE is read as in 'hks-jax hks'.

The command writes to the folder OUT: spectrum.csv and spectrum.npz (eigenvalues, residuals, and the counts of
eigenvalues by Weyl's law), spectrum.png and report.json. The default boundary condition is neumann even for a mask,
because mean would join the eigenvalues of two problems.

examples:
  hks-jax spectrum tensor.nii.gz -o out --mask mask.nii.gz --slice z=14 --metric inverse -k 300
  hks-jax spectrum field.npz -o out -k 50 -q --json | jq .eigenvalues
"""

import argparse
import csv
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from hks_jax import Eigenpairs, TensorField
from hks_jax.cli import options
from hks_jax.cli.computation import Settings, compute_pairs, describe_pairs
from hks_jax.cli.outputs import REPORT, Done, writing
from hks_jax.cli.progress import Progress
from hks_jax.cli.reading import Reading, read_grid
from hks_jax.eigen.weyl import weyl_count

USAGE = "FILE -o OUT"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    options.add_file(parser)
    options.add_metric(parser)
    options.add_reading(parser)
    options.add_output(parser)
    options.add_solving(parser)


def writes(args: argparse.Namespace) -> list[Path]:
    """Return the files that the command may write."""
    return [args.output / name for name in ("spectrum.csv", "spectrum.npz", "spectrum.png", REPORT)]


def run(args: argparse.Namespace, progress: Progress) -> Done:
    """Run the command."""
    settings = Settings.of(args, boundary=args.boundary or "neumann")
    domain = read_grid(Reading.of(args), settings, progress)
    solved = compute_pairs(domain, settings, progress)
    pairs = solved.pairs
    columns: dict[str, Any] = {
        "eigenvalues": np.asarray(pairs.eigenvalues),
        "residuals": np.asarray(pairs.residuals),
        "weyl_counts": weyl_count(pairs, pairs.eigenvalues, domain.field),
    }
    report = {
        "input": domain.about,
        "settings": {**solved.settings.of_pairs, "k": pairs.k},
        "eigenpairs": describe_pairs(pairs),
        "volume": np.asarray(pairs.pencil.volume).item(),
        "eigenvalues": columns["eigenvalues"].tolist(),
    }
    with writing(args.output, report, progress, pictures={"spectrum.png": partial(_draw, pairs, domain.field)}) as (
        folder,
        done,
    ):
        np.savez_compressed(folder / "spectrum.npz", **columns)
        with open(folder / "spectrum.csv", "w", newline="", encoding="utf-8") as stream:
            writer = csv.writer(stream)
            writer.writerow(["index", *(name.removesuffix("s") for name in columns)])
            rows = zip(*(column.tolist() for column in columns.values()), strict=True)
            writer.writerows([i, *row] for i, row in enumerate(rows))
    return done


def _draw(pairs: Eigenpairs, field: TensorField, path: Path) -> None:
    from hks_jax.plot import new_figure, save_figure, spectrum

    figure = new_figure(9.0, 3.8)
    counts, remainder = figure.subplots(1, 2)
    spectrum(counts, pairs, field)
    spectrum(remainder, pairs, field, remainder=True)
    save_figure(figure, path)
