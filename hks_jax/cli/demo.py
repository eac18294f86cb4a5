"""Compute and draw the signature of a brain slice.

Fit diffusion tensors to a slice of a real brain and draw its heat kernel signature. The PyPI wheel mdt==1.2.7 contains
the brain (install it with --no-deps), and the fit needs "hks-jax[dti]". If the wheel or the extra is missing, or with
--phantom, the command uses an analytic phantom.

examples:
  hks-jax demo
  hks-jax demo --phantom -o phantom
"""

import argparse
import importlib.util
from functools import partial

from hks_jax.cli import options
from hks_jax.cli.computation import Settings, compute_pairs, domain_of_volume
from hks_jax.cli.noise import signature_of
from hks_jax.cli.outputs import Done, write_outputs
from hks_jax.cli.parsing import Times, folder
from hks_jax.cli.progress import Progress
from hks_jax.domain import examples
from hks_jax.io import TensorVolume, erode, find_example_brain, fit_dwi
from hks_jax.io.units import MM2_PER_S

USAGE = ""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument(
        "-o", "--output", type=folder, default="demo", metavar="OUT", help="folder for the results (default demo)"
    )
    parser.add_argument("--phantom", action="store_true", help="use the phantom even if the brain is installed")
    options.add_view(parser)
    options.add_rim(parser)


B_MAX = 1000.0
"""The largest b-value, in s/mm², up to which a single tensor describes the signal well."""
RIM = 2
"""The number of voxels eroded from the mask, because boundary voxels contain several tissues and have bad fits."""
N_TIMES = 7
"""The number of drawn times, from the first resolved time to the time at which half of the nodes are near the rim."""
N_PAIRS = 600
"""The number of eigenpairs of both boundary problems together."""
PHANTOM_SHAPE = (72, 80)


def run(args: argparse.Namespace, progress: Progress) -> Done:
    """Run the command."""
    from hks_jax.plot import signature_panels

    brain = None if args.phantom else find_example_brain()
    if not args.phantom and (brain is None or importlib.util.find_spec("dipy") is None):
        progress.note('using a phantom, because the brain needs the wheel mdt==1.2.7 and pip install "hks-jax[dti]"')
        brain = None
    if brain is None:
        tensors, mask, spacing = examples.phantom(PHANTOM_SHAPE)
        volume = TensorVolume(tensors, spacing, (0.0, 0.0), mask, source="phantom", length_unit="mm", unit=MM2_PER_S)
    else:
        with progress.stage("tensor fit", f"{brain.images.name}, b ≤ {B_MAX:g} s/mm²"):
            volume = fit_dwi(brain.images, brain.bval, brain.bvec, brain.mask, b_max=B_MAX).slice("z", 0)
            volume = volume.with_mask(erode(volume.inside, RIM))
    settings = Settings.of(metric="inverse", components="largest", k=N_PAIRS, times=Times((), N_TIMES))
    solved = compute_pairs(domain_of_volume(volume, settings), settings, progress)
    result = signature_of(solved, None, progress)
    title = (
        rf"$4\pi t\,$HKS of {'a phantom' if brain is None else 'a brain slice'}, metric D⁻¹. The value 1 means flat; "
        "larger values mean positive curvature"
    )
    drawing = partial(signature_panels, result, title=title, view=args.view, show_rim=args.show_rim)
    done = write_outputs(args.output, result, progress, drawing, "" if brain is None else ".nii.gz")
    picture = next(file for file in done.files if file.suffix == ".png")
    return done._replace(text=f"The picture is {picture}")
