"""Write a page to explore a signature in a browser.

Write a page to explore the signature that 'hks-jax hks' has written to the folder OUT. The page is one HTML file that
any browser opens without a network. The page has sliders for t and the slice, maps of the signature and of the tensors,
curves over t at chosen points, the distances between a chosen point's curve and all other curves, and mean curves of
regions. Curves can be saved as CSV, and surfaces can be rotated.

examples:
  hks-jax hks tensor.nii.gz -o out --mask mask.nii.gz --slice z=14 --metric inverse --times auto:24
  hks-jax explore out
  hks-jax explore out -o page.html --labels atlas.nii.gz --names names.tsv --title "Subject 7"
  hks-jax explore out --anatomy T1w.nii.gz
"""

import argparse
from pathlib import Path

from hks_jax.cli import options
from hks_jax.cli.combinations import refuse
from hks_jax.cli.outputs import Done
from hks_jax.cli.parsing import file_in_folder
from hks_jax.cli.progress import Progress
from hks_jax.cli.stats import names_of
from hks_jax.io import sample_image
from hks_jax.io.masks import read_labels
from hks_jax.io.result import Result, signature_file

USAGE = "RESULT"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument(
        "result", type=Path, metavar="RESULT", help="the folder OUT that 'hks-jax hks' wrote, or an .npz from there"
    )
    parser.add_argument(
        "-o", "--output", type=file_in_folder, metavar="PAGE", help="the page (default: explore.html in OUT)"
    )
    parser.add_argument(
        "--labels",
        type=Path,
        metavar="FILE",
        help="region numbers on the same voxels or at the vertices, with 0 for unlabelled (NIfTI, MRtrix, NRRD or "
        ".npy)",
    )
    options.add_names(parser)
    parser.add_argument(
        "--anatomy",
        type=Path,
        metavar="FILE",
        help="an anatomical image, such as a T1-weighted one in the space of the tensors, which lies in grey under "
        "the signature. It is interpolated at the voxels of the result through the affines (NIfTI, MRtrix or NRRD)",
    )
    parser.add_argument("--title", metavar="TEXT", help="the page's title (default: the name of the tensors' file)")
    parser.add_argument(
        "--unit-of-t", metavar="TEXT", help="unit of t, if the result does not have it (default: that of the result)"
    )
    options.add_view(parser)


def writes(args: argparse.Namespace) -> list[Path]:
    """Return the files that the command may write."""
    return [_page(args)]


def _page(args: argparse.Namespace) -> Path:
    return args.output or signature_file(args.result).with_name("explore.html")


def run(args: argparse.Namespace, progress: Progress) -> Done:
    """Run the command."""
    from hks_jax.plot import explore

    source, page = signature_file(args.result), _page(args)
    if page.suffix.lower() not in (".html", ".htm"):
        raise ValueError(f"--output: got {page}; expected a name that ends in .html")
    if args.labels is None:
        refuse(args, ("names",), "this option names the labels, which are missing; pass --labels too")
    with progress.stage("reading", str(source)):
        result = Result.read(source, "hks", over_times=True)
        labels = names = anatomy = None
        if args.labels is not None:
            labels, names = read_labels(args.labels, result.place), names_of(args.labels, args.names)[1]
        if args.anatomy is not None:
            anatomy = sample_image(args.anatomy, result.volume)
    with progress.stage("writing", str(page)):
        title = args.title or Path(getattr(result.place, "source", "")).name or source.parent.name
        style = {"title": title, "unit": args.unit_of_t, "view": args.view}
        explore(result, page, anatomy=anatomy, labels=labels, label_names=names, **style)
    return Done([page], {"source": str(source), "times": result.times.tolist()})
