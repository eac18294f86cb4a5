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

from hks_jax import TensorNoise
from hks_jax.cli import pairs as saved_pairs
from hks_jax.cli.computation import Settings, compute_pairs, result_of, use_dtype
from hks_jax.cli.info import describe_mesh
from hks_jax.cli.meshes import NO_NOISE, OF_MESHES, Domain, domain_of, images_of_mesh, solve_mesh
from hks_jax.cli.noise import Noisy, check_noise, noise_of_volume, signature_of, with_error_bars
from hks_jax.cli.options import READING, SOLVING, options_in, refuse
from hks_jax.cli.outputs import PAIRS, REPORT, Done, of_earlier, write_outputs
from hks_jax.cli.progress import Progress
from hks_jax.cli.reading import read_volume, require_metric
from hks_jax.io.formats import format_of
from hks_jax.io.mesh import is_mesh

OPTIONS = f"""
@file @metric {READING} @output {SOLVING}
--through I,J,K
    voxel through which the slices in the picture of a volume pass, or else the nearest voxel in the domain (default: a
    voxel in the middle)
{OF_MESHES}
@signature @noise @view @rim
--save-pairs  write the eigenpairs to OUT/pairs.npz; 'hks-jax hks OUT/pairs.npz --times …' reuses them
"""


def writes(args: argparse.Namespace) -> list[Path]:
    """Return the files that the command may write."""
    return [args.output / name for name in ("hks.*", REPORT, *[PAIRS] * args.save_pairs)]


def run(args: argparse.Namespace, progress: Progress) -> Done:
    """Run the command."""
    check_noise(args)
    if is_mesh(args.file):
        return _on_mesh(args, Settings.of(args, metric=args.metric), progress)
    refuse(args, ("clean", "inside"), "this option is for meshes; for tensors on a grid, see --repair and --mask")
    refuse(args, ("tensors",), "this option is for a mesh inside a volume; leave it out for the volume itself")
    if saved := not args.others and saved_pairs.is_saved_pairs(args.file):
        refuse(args, ("noise",), NO_NOISE)
        settled = [option.name for option in options_in(f"@metric {READING} {SOLVING}")]
        why = f"the eigenpairs in {args.file} determine this setting; leave the option out"
        refuse(args, (*settled, "save_pairs"), why)
    else:
        require_metric(args)
    from hks_jax.plot import signature_panels

    settings = Settings.of(args)
    if saved:
        solved, image = saved_pairs.read_pairs(args.file, settings, progress)
        volume = solved.volume
    else:
        volume, image = read_volume(args, progress), format_of(args.file).image
    if volume.dimension == 2:
        refuse(args, ("through",), "this option is for a volume; leave it out for a slice")
    noise = None
    if not saved:
        if args.noise is not None:  # the noise is read first, because reading it may fail
            use_dtype(args.dtype)
            noise = noise_of_volume(args, volume, volume.grid(args.components), progress)
        solved = compute_pairs(volume, settings, progress)
    if args.save_pairs:  # the eigenpairs are written first, because later steps may fail
        with progress.stage("writing", str(args.output / PAIRS)):
            for file in of_earlier(args.output, np.asarray(solved.pairs.eigenvalues), progress):
                file.unlink(missing_ok=True)
            saved_pairs.write_pairs(args.output / PAIRS, solved, image, progress.warnings)
    result = signature_of(args, solved, noise, progress)
    style = {"view": args.view, "through": args.through, "show_rim": args.show_rim}
    drawing = partial(signature_panels, result, **style)
    done = write_outputs(args.output, result, progress, drawing, image)
    return done._replace(files=[*done.files, *[args.output / PAIRS] * args.save_pairs])


def _on_mesh(args: argparse.Namespace, settings: Settings, progress: Progress) -> Done:
    from hks_jax.plot import signature_panels

    domain = domain_of(args, progress)
    mesh, noisy = domain.mesh, _noise_on(domain, args, progress)
    pairs, settings = solve_mesh(mesh, settings, progress)
    described = {"source": str(args.file), **describe_mesh(args.file, mesh)}
    of_pairs = partial(result_of, mesh, described, pairs)
    if noisy is None:
        result = of_pairs(settings, progress)
    else:
        result = with_error_bars(args, of_pairs, noisy, pairs, settings, progress)
    drawing = partial(signature_panels, result, show_rim=args.show_rim)
    images, origin = images_of_mesh(args.file, mesh, args.clean)
    return write_outputs(args.output, result, progress, drawing, *images, origin=origin)


def _noise_on(domain: Domain, args: argparse.Namespace, progress: Progress) -> Noisy | None:
    """Return the tensors of a mesh and their noise for error bars, if the options ask for them."""
    if args.noise is None:
        return None
    assert domain.tensors is not None
    assert domain.of_tensors is not None
    if domain.volume is not None:
        noise = noise_of_volume(args, domain.volume, domain.volume.grid("all"), progress)
        assert noise is not None
        return Noisy(domain.tensors, noise, domain.of_tensors, traceable=False)
    try:
        level = float(args.noise)
    except ValueError:
        raise ValueError(
            f"--noise: got {args.noise!r}; expected a number, relative to the mean diffusivity, for tensors of a mesh"
        ) from None
    return Noisy(domain.tensors, TensorNoise.relative(domain.tensors, level), domain.of_tensors)
