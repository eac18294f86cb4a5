"""Compute the signature of a tensor field in a file.

Compute the heat kernel signature of a field of diffusion tensors. FILE holds one of

  tensors                    of a volume, which is computed whole unless --slice cuts it; pass --metric
  diffusion-weighted images  with --bval and --bvec: tensors are fitted to them
  a mesh                     of triangles or tetrahedra, with the metric of space, or with that of the tensors at its
                             vertices that --array names, or of the volume --tensors in which it lies
  eigenpairs                 which --save-pairs has kept: for other times, or another normalisation or method

The folder OUT gets hks.npz, an image or a mesh in FILE's format (times along the fourth axis), hks.png and report.json.

examples:
  hks-jax hks tensor.nii.gz -o out --metric inverse
  hks-jax hks tensor.nii.gz -o out --mask mask.nii.gz --slice z=14 --metric inverse -k 100 --times auto:8
  hks-jax hks out/pairs.npz -o later --times auto:24 --normalisation flat
  hks-jax hks heart.vtu -o out --array D --metric inverse -k 50
  hks-jax hks lh.white --tensors dti.nii.gz -o out --metric inverse
  hks-jax hks dwi.nii.gz --bval dwi.bval --bvec dwi.bvec -o out --slice z=10 --metric inverse --components largest
"""

import argparse
from dataclasses import replace
from functools import partial

import numpy as np

from hks_jax import assemble
from hks_jax.cli import pairs as saved_pairs
from hks_jax.cli.job import Settings, compute_pairs, result_of, solve
from hks_jax.cli.noise import require_spectral, signature_of
from hks_jax.cli.options import READING, SOLVING, parse_times, refuse
from hks_jax.cli.outputs import PAIRS, Done, of_earlier, write_outputs
from hks_jax.cli.progress import Progress
from hks_jax.cli.reading import image_suffix, read_volume, require_metric
from hks_jax.io import TensorVolume
from hks_jax.io.mesh import is_mesh

OPTIONS = f"""
@file @metric {READING} @output {SOLVING}
--through I,J,K  the voxel that the slices in the picture of a volume run through (default: one in the middle)
@clean
--tensors FILE
    of a mesh that lies in a volume, such as a cortex: the tensors, sampled at its vertices in the coordinates of the
    scanner (FreeSurfer's surfaces are moved by c_ras, GIFTI's by their transformation); options on voxels and numbers
    are about this file
@signature @noise @view
--save-pairs  keep the eigenpairs, in OUT as pairs.npz: 'hks-jax hks OUT/pairs.npz --times …' solves nothing again
"""


def run(args: argparse.Namespace, progress: Progress) -> Done:
    """Run the command."""
    times = parse_times(args.times)
    if is_mesh(args.file):
        refuse(args, ("noise",), "it is for tensors on a grid; leave it out for meshes and for eigenpairs")
        return _on_mesh(args, Settings.of(args, metric=args.metric, times=times), progress)
    refuse(args, ("clean",), "it is for meshes; leave it out for tensors on a grid, and see --repair")
    refuse(args, ("tensors",), "it is for a mesh that lies in a volume; leave it out for the volume itself")
    return _on_grid(args, Settings.of(args, times=times), progress)


def _on_mesh(args: argparse.Namespace, settings: Settings, progress: Progress) -> Done:
    from hks_jax.cli import mesh as meshes

    meshes.check_options(args)
    with progress.stage("reading", str(args.file)):
        mesh = meshes.read_domain(args, progress)
    boundary = settings.boundary or "neumann"
    settings = replace(settings, boundary=boundary)
    with progress.stage("assembly", f"{len(mesh.vertices)} vertices"):
        pencil = assemble(mesh, boundary)
    pairs = solve(pencil, settings, progress)
    result = result_of(mesh, meshes.describe_mesh(args.file, mesh), pairs, settings, progress)
    image = meshes.mesh_suffix(args.file, mesh)
    return write_outputs(args.output, result, progress, partial(meshes.draw, result), image)


def _on_grid(args: argparse.Namespace, settings: Settings, progress: Progress) -> Done:
    saved = saved_pairs.is_saved_pairs(args.file)
    require_spectral(args)
    if saved:
        refuse(args, ("noise",), "it is for tensors on a grid; leave it out for meshes and for eigenpairs")
        saved_pairs.check_options(args)
    else:
        require_metric(args)
    from hks_jax.cli.picture import draw

    if saved:
        volume, field, pairs, settings, image = saved_pairs.read_pairs(args.file, settings, progress)
    else:
        volume, image = read_volume(args, progress), image_suffix(args.file)
    if args.through is not None:
        _check_voxel(args.through, volume)
    if not saved:
        field, pairs, settings = compute_pairs(volume, settings, progress)
    if args.save_pairs:  # at once: what comes after may fail, or be interrupted
        with progress.stage("writing", str(args.output / PAIRS)):
            for file in of_earlier(args.output, np.asarray(pairs.eigenvalues), progress):
                file.unlink(missing_ok=True)
            domain = volume.with_mask(field.grid.mask)
            saved_pairs.write_pairs(args.output / PAIRS, domain, pairs, settings, image, progress.warnings)
    result = signature_of(args, volume, field, pairs, settings, progress)
    drawing = partial(draw, result, view=args.view, through=args.through)
    return write_outputs(args.output, result, progress, drawing, image)


def _check_voxel(voxel: tuple[int, int, int], volume: TensorVolume) -> None:
    """Raise ValueError, before the long computation, for a voxel through which no slices can be drawn."""
    text = ",".join(map(str, voxel))
    if volume.dimension != 3:
        raise ValueError(f"--through: got {text}; only the picture of a volume has slices, not that of one slice")
    if not all(i < n for i, n in zip(voxel, volume.shape, strict=True)):
        raise ValueError(f"--through: got {text}; expected a voxel of the volume, whose shape is {volume.shape}")
    if volume.mask is not None and not volume.mask[voxel]:
        middle = ",".join(map(str, np.argwhere(volume.mask)[volume.mask.sum() // 2]))
        raise ValueError(f"--through: voxel {text} is outside the mask; {middle}, for one, is inside")
