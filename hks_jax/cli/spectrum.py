"""``hks-jax spectrum FILE -o OUT``: the eigenvalues of a tensor field in a file, against Weyl's law."""

import argparse
import csv
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from hks_jax.cli.arguments import DEFAULT_TIMES, NATURAL
from hks_jax.cli.hks import settings_of
from hks_jax.cli.inputs import (
    add_command,
    add_eigenpair_arguments,
    add_json_argument,
    add_tensor_arguments,
    read_volume,
    require_metric,
)
from hks_jax.cli.job import compute_pairs, describe_input, describe_pairs
from hks_jax.cli.outputs import check_folder, show_files, writing
from hks_jax.cli.progress import Progress
from hks_jax.domain.tensor_field import TensorField
from hks_jax.eigen.eigenpairs import Eigenpairs
from hks_jax.eigen.weyl import weyl_count

DESCRIPTION = """\
Compute the lowest eigenvalues of the Laplace-Beltrami operator of a field of diffusion tensors. FILE is read as by
'hks-jax hks'.

Writes to the folder OUT: spectrum.csv and spectrum.npz (eigenvalues, their residuals, and how many there are up to each
by Weyl's law), spectrum.png and report.json.
"""

EPILOG = """\
examples:
  hks-jax spectrum tensor.nii.gz -o out --mask mask.nii.gz --slice z=14 --metric inverse -k 300
  hks-jax spectrum field.npz -o out -k 50 -q --json | jq .eigenvalues
"""


def add_parser(subparsers: Any) -> argparse.ArgumentParser:
    """Add the subcommand's parser."""
    parser = add_command(
        subparsers, "spectrum", "compare eigenvalues with Weyl's law", DESCRIPTION, EPILOG, "FILE -o OUT"
    )
    add_tensor_arguments(parser)
    add_eigenpair_arguments(parser, "neumann, also of a mask: mean would join the eigenvalues of two problems", NATURAL)
    add_json_argument(parser)
    return parser


def run(args: argparse.Namespace) -> None:
    """Run the subcommand."""
    require_metric(args)
    from hks_jax.plot import save_figure

    check_folder(args.output)
    progress = Progress(args.quiet)
    with progress.catching_warnings():
        with progress.stage("reading", str(args.file)):
            volume = read_volume(args, progress)
        settings = settings_of(args, DEFAULT_TIMES, args.metric or "tensor")
        field, pairs, settings = compute_pairs(volume, settings, progress)
        columns = {
            "eigenvalue": np.asarray(pairs.eigenvalues),
            "residual": np.asarray(pairs.residuals),
            "weyl_count": weyl_count(pairs, pairs.eigenvalues, field),
        }
        chosen = asdict(settings)
        for name in ("times", "normalisation", "method"):
            del chosen[name]
        report = {
            "input": describe_input(volume, field.grid.mask),
            "settings": {**chosen, "k": pairs.k},
            "eigenpairs": describe_pairs(pairs),
            "volume": np.asarray(pairs.pencil.volume).item(),
            "eigenvalues": columns["eigenvalue"].tolist(),
        }
        with writing(args.output, report, progress) as (folder, files):
            np.savez_compressed(
                folder / "spectrum.npz",
                eigenvalues=columns["eigenvalue"],
                residuals=columns["residual"],
                weyl_counts=columns["weyl_count"],
            )
            write_csv(folder / "spectrum.csv", columns)
            save_figure(draw(pairs, field), folder / "spectrum.png")
    show_files(files, args.quiet, args.json)


def write_csv(path: Path, columns: dict[str, np.ndarray]) -> None:
    """Write numbered rows with every digit."""
    with open(path, "w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(["index", *columns])
        rows = zip(*(column.tolist() for column in columns.values()), strict=True)
        writer.writerows([i, *row] for i, row in enumerate(rows))


def draw(pairs: Eigenpairs, field: TensorField) -> Any:
    """Return the picture: the eigenvalues' count beside Weyl's law, and what is left when that is taken off."""
    from hks_jax.plot import new_figure, spectrum

    figure = new_figure(9.0, 3.8)
    counts, remainder = figure.subplots(1, 2)
    spectrum(counts, pairs, field)
    spectrum(remainder, pairs, field, remainder=True)
    return figure
