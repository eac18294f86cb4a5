"""``hks-jax explore OUT``: a page to explore what ``hks-jax hks`` has computed."""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from hks_jax.cli.inputs import add_command, add_json_argument
from hks_jax.cli.outputs import check_folder, show_summary, signature_file
from hks_jax.cli.progress import Progress
from hks_jax.cli.saved import About as About
from hks_jax.cli.saved import Place as Place
from hks_jax.cli.saved import read_saved
from hks_jax.domain.grid import Grid
from hks_jax.domain.surface_mesh import SurfaceMesh
from hks_jax.io.masks import read_labels, read_names
from hks_jax.npz import load_npz

DESCRIPTION = """\
Write a page to explore the signature that 'hks-jax hks' has left in the folder OUT: one HTML file that any browser
opens, without a network. It has sliders for t and the slice, maps of the tensors beside the signature, the curves of
the points that you choose and their distance to all others, and the mean curves of regions, to be saved as CSV.
Surfaces are turned by hand.
"""

EPILOG = """\
examples:
  hks-jax hks tensor.nii.gz -o out --mask mask.nii.gz --slice z=14 --metric inverse --times auto:24
  hks-jax explore out
  hks-jax explore out -o page.html --labels atlas.nii.gz --names names.tsv --title "Subject 7"
"""


def add_parser(subparsers: Any) -> argparse.ArgumentParser:
    """Add the subcommand's parser."""
    parser = add_command(subparsers, "explore", "write a page to explore a signature in a browser", DESCRIPTION, EPILOG)
    add = parser.add_argument
    add("result", metavar="OUT", type=Path, help="the folder that 'hks-jax hks' wrote, or an .npz from there")
    add("-o", "--output", metavar="PAGE", type=Path, help="the page (default: explore.html in OUT)")
    add(
        "--labels",
        metavar="FILE",
        type=Path,
        help="regions: whole numbers on the same voxels or at the vertices, 0 for none (NIfTI, .npy)",
    )
    add("--names", metavar="FILE", type=Path, help="names of the labels: lines of a number, a tab or space, and a name")
    add("--title", help="the page's title (default: the name of the tensors' file)")
    add("--unit", help="the unit of t (default: s for D⁻¹ of tensors fitted here, else none)")
    add_json_argument(parser)
    return parser


def run(args: argparse.Namespace) -> None:
    """Run the subcommand.

    Raises:
        FileNotFoundError: no such result, labels or names.
        ValueError: a result that cannot be shown, or labels that do not fit it.
    """
    from hks_jax.plot import explore

    source = signature_file(args.result)
    page = source.with_name("explore.html") if args.output is None else args.output
    if page.suffix.lower() not in (".html", ".htm"):
        raise ValueError(f"--output: got {page}; expected a name that ends in .html")
    if args.names is not None and args.labels is None:
        raise ValueError("--names: it names labels; pass --labels too")
    check_folder(page.parent)
    progress = Progress(args.quiet)
    with progress.catching_warnings():
        with progress.stage("reading", str(source)):
            more = load_npz(source)
            values, times, domain = _read(source, more)
            place = Place.of(more, values.ndim - 1)
            labels = None
            if args.labels is not None:
                labels = read_labels(args.labels, values.shape[1:], place.affine, place.slice_axis)
            names = None if args.names is None else read_names(args.names)
        about = About.of(more)
        with progress.stage("writing", str(page)):
            explore(
                values,
                times,
                domain,
                page,
                deviation=more.get("deviation"),
                tensors=more.get("input_tensors"),
                labels=labels,
                label_names=names,
                normalisation=about.settings.get("normalisation", "raw"),
                title=args.title or about.title or source.parent.name,
                facts=_facts(about, domain),
                unit=about.unit if args.unit is None else args.unit,
                lengths=_spread(more.get("input_tensors"), values, times, about),
                length_unit="" if place.affine is None else "mm",
                world=place.world,
            )
    show_summary(args, [page], {"source": str(source), "times": times.tolist()})


def _read(source: Path, arrays: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray, Grid | SurfaceMesh]:
    """Return the signature, its times, and the grid or the surface that it is on."""
    if "cells" in arrays:
        raise ValueError(f"{source}: is on tetrahedra; expected a grid or a surface. ParaView shows the .vtu beside it")
    if "faces" in arrays and {"hks", "times", "vertices"} <= set(arrays):
        return arrays["hks"], arrays["times"], SurfaceMesh(arrays["vertices"], arrays["faces"])
    saved = read_saved(source, "hks", over_times=True)
    assert saved.times is not None
    return saved.values, saved.times, saved.grid


def _spread(tensors: np.ndarray | None, values: np.ndarray, times: np.ndarray, about: About) -> np.ndarray | None:
    """Return √(Dt), where t is the time of a diffusion: with the median of the mean diffusivity inside."""
    if tensors is None or about.settings.get("metric") != "inverse":
        return None
    inside = np.isfinite(values[0])
    diffusivity = float(np.median(np.trace(tensors[inside], axis1=-2, axis2=-1))) / tensors.shape[-1]
    return np.sqrt(diffusivity * times) if diffusivity > 0 else None


def _facts(about: About, domain: Grid | SurfaceMesh) -> dict[str, Any]:
    settings, words = about.settings, {"tensor": "D itself", "inverse": "D⁻¹", "adjugate": "|D|D⁻¹"}
    facts: dict[str, Any] = {}
    if isinstance(domain, Grid):
        facts["grid"] = " × ".join(map(str, domain.shape))
    else:
        facts |= {"vertices": len(domain.vertices), "triangles": len(domain.faces)}
    if about.cut:
        facts["slice"] = about.cut
    if settings.get("metric"):
        facts["metric"] = words.get(settings["metric"], settings["metric"])
    if settings.get("boundary"):
        boundary = settings["boundary"]
        facts["boundary"] = boundary if isinstance(boundary, str) else json.dumps(boundary)
    if about.k is not None and settings.get("method", "spectral") == "spectral":
        facts["eigenpairs"] = about.k
    return facts
