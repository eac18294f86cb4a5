"""Compute the signature of a tensor field in a file.

Compute the heat kernel signature of a field of diffusion tensors. FILE contains one of

  tensors                    of a volume; --metric is required, and --slice restricts the computation to a slice
  diffusion-weighted images  with --bval and --bvec, to which tensors are fitted
  a mesh                     of triangles or tetrahedra, with the Euclidean metric, or of tensors at its vertices or
                             cells (--array), or of tensors in a volume (--tensors)
  eigenpairs                 written by --save-pairs, for other times, or another normalisation or method

The command writes to the folder OUT: hks.npz, an image or a mesh in FILE's format, hks.png and report.json. Times are
along the fourth axis of the image. For a GIFTI or FreeSurfer surface, the mesh is hks.vtu, for ParaView; hks.func.gii
has the values at the vertices of FILE, for Workbench, freeview and nilearn. Beside files of VTK, hks.pvd lists the same
values as a time series of files, for ParaView.

examples:
  hks-jax hks tensor.nii.gz -o out --metric inverse
  hks-jax hks tensor.nii.gz -o out --mask mask.nii.gz --slice z=14 --metric inverse -k 100 --times auto:8
  hks-jax hks out/pairs.npz -o later --times auto:24
  hks-jax hks heart.vtu -o out --array D --metric inverse -k 50
  hks-jax hks lh.white --tensors dti.nii.gz -o out --metric inverse
  hks-jax hks dwi.nii.gz --bval dwi.bval --bvec dwi.bvec -o out --slice z=10 --metric inverse --components largest
"""

import argparse
from functools import partial
from pathlib import Path

import numpy as np

from hks_jax.cli import options
from hks_jax.cli.combinations import refuse
from hks_jax.cli.computation import compute_pairs
from hks_jax.cli.noise import noise_of, signature_of
from hks_jax.cli.outputs import PAIRS, REPORT, Done, of_earlier, write_outputs
from hks_jax.cli.pairs import write_pairs
from hks_jax.cli.parsing import voxel
from hks_jax.cli.progress import Progress
from hks_jax.cli.reading import Reading
from hks_jax.cli.source import read_source
from hks_jax.io import TensorVolume

USAGE = "FILE -o OUT"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    options.add_file(parser)
    options.add_metric(parser)
    options.add_reading(parser)
    options.add_output(parser)
    options.add_solving(parser)
    parser.add_argument(
        "--through",
        type=voxel,
        metavar="I,J,K",
        help="voxel through which the slices in the picture of a volume pass, or else the nearest voxel in the domain "
        "(default: a voxel in the middle)",
    )
    options.add_meshes(parser)
    options.add_signature(parser)
    options.add_noise(parser)
    parser.add_argument(
        "--checkpoint",
        type=Path,
        metavar="FILE",
        help="file that is written after every four noisy maps; if the file exists, error bars continue from it",
    )
    options.add_view(parser)
    options.add_rim(parser)
    parser.add_argument(
        "--save-pairs",
        action="store_true",
        help="write the eigenpairs to OUT/pairs.npz; 'hks-jax hks OUT/pairs.npz --times …' reuses them",
    )


def writes(args: argparse.Namespace) -> list[Path]:
    """Return the files that the command may write."""
    checkpoint = [] if args.checkpoint is None else [args.checkpoint]
    return [*(args.output / name for name in ("hks.*", REPORT, *[PAIRS] * args.save_pairs)), *checkpoint]


def run(args: argparse.Namespace, progress: Progress) -> Done:
    """Run the command."""
    domain, settings, solved = read_source(args, progress)
    if isinstance(domain.place, TensorVolume) and domain.place.dimension == 2:
        refuse(args, ("through",), "this option is for a volume; leave it out for a slice")
    noise = noise_of(domain, Reading.of(args), args.draws, progress)  # before the eigenpairs, because it may fail
    solved = solved or compute_pairs(domain, settings, progress, keep_spare=noise is not None)
    kept = args.output / PAIRS
    if args.save_pairs:  # before later steps, which may fail
        with progress.stage("writing", str(kept)):
            for file in of_earlier(args.output, np.asarray(solved.pairs.eigenvalues), progress):
                file.unlink(missing_ok=True)
            write_pairs(kept, solved, progress.warnings)
    result = signature_of(solved, noise, progress, args.checkpoint)
    from hks_jax.plot import signature_panels

    draw = partial(signature_panels, result, view=args.view, through=args.through, show_rim=args.show_rim)
    done = write_outputs(args.output, result, progress, draw, *domain.images, origin=domain.origin)
    return done._replace(files=done.files + [kept] * args.save_pairs)
