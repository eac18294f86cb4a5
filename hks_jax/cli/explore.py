"""Write a page to explore a signature in a browser.

Write a page to explore the signature that 'hks-jax hks' has written to the folder OUT. The page is one HTML file that
any browser opens without a network. It has sliders for t and the slice, maps of the signature and of the tensors,
curves over t at chosen points, the distances between a chosen point's curve and all other curves, and mean curves of
regions. Curves can be saved as CSV, and surfaces can be rotated.

examples:
  hks-jax hks tensor.nii.gz -o out --mask mask.nii.gz --slice z=14 --metric inverse --times auto:24
  hks-jax explore out
  hks-jax explore out -o page.html --labels atlas.nii.gz --names names.tsv --title "Subject 7"
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from hks_jax.cli.options import refuse
from hks_jax.cli.outputs import Done
from hks_jax.cli.progress import Progress
from hks_jax.cli.stats import names_of
from hks_jax.domain.simplicial_mesh import SurfaceMesh, TetMesh
from hks_jax.io.masks import read_labels
from hks_jax.io.result import Result, signature_file
from hks_jax.io.volume import TensorVolume

OPTIONS = """
result RESULT  the folder OUT that 'hks-jax hks' wrote, or an .npz from there
-o,--output PAGE  the page (default: explore.html in OUT)
--labels FILE  region numbers on the same voxels or at the vertices, with 0 for unlabelled (NIfTI, .npy)
@names
--title TEXT  the page's title (default: the name of the tensors' file)
--unit TEXT  the unit of t (default: s for the metric D⁻¹ of tensors from --bval and --bvec, otherwise none)
"""


def run(args: argparse.Namespace, progress: Progress) -> Done:
    """Run the command."""
    from hks_jax.plot import explore

    source = signature_file(args.result)
    page = args.output or source.with_name("explore.html")
    if page.suffix.lower() not in (".html", ".htm"):
        raise ValueError(f"--output: got {page}; expected a name that ends in .html")
    if args.labels is None:
        refuse(args, ("names",), "this option names the labels, which are missing; pass --labels too")
    with progress.stage("reading", str(source)):
        result = Result.read(source, "hks", over_times=True)
        place, affine, world = result.place, None, None
        if isinstance(place, TetMesh):
            raise ValueError(f"{source}: got a result on tetrahedra; expected a grid or a surface. Use ParaView")
        if isinstance(place, TensorVolume) and place.affine is not None:
            affine, axes = place.affine, [a for a in range(4) if place.dimension == 3 or a != place.thin_axis]
            world = affine[:3, axes]
        labels, names = None, None
        if args.labels is not None:
            labels = read_labels(args.labels, place)
            names = names_of(args.labels, args.names)[1] or None
    with progress.stage("writing", str(page)):
        explore(
            result.values,
            result.times,
            place if isinstance(place, SurfaceMesh) else result.grid,
            page,
            deviation=result.arrays.get("deviation"),
            tensors=result.arrays.get("input_tensors"),
            labels=labels,
            label_names=names,
            normalisation=result.settings.get("normalisation", "raw"),
            title=args.title or Path(getattr(place, "source", "")).name or source.parent.name,
            facts=_facts(result),
            unit=result.unit if args.unit is None else args.unit,
            lengths=_spread(result),
            length_unit="" if affine is None else "mm",
            world=world,
        )
    return Done([page], {"source": str(source), "times": result.times.tolist()})


def _spread(result: Result) -> np.ndarray | None:
    """Return the lengths √(Dt) for the metric D⁻¹, where D is the median mean diffusivity inside; otherwise None."""
    tensors = result.arrays.get("input_tensors")
    if tensors is None or result.settings.get("metric") != "inverse":
        return None
    inside = np.isfinite(result.values[0])
    diffusivity = float(np.median(np.trace(tensors[inside], axis1=-2, axis2=-1))) / tensors.shape[-1]
    return np.sqrt(diffusivity * result.times) if diffusivity > 0 else None


def _facts(result: Result) -> dict[str, Any]:
    settings, place, facts = result.settings, result.place, dict[str, Any]()
    if isinstance(place, TensorVolume):
        facts["grid"] = " × ".join(map(str, place.shape))
        facts |= {note[:5]: note[6:].partition(":")[0] for note in place.notes if note.startswith("slice ")}
    else:
        facts |= {"vertices": len(place.vertices), "triangles": len(place.triangulation.cells)}
    if metric := settings.get("metric"):
        facts["metric"] = {"tensor": "D itself", "inverse": "D⁻¹", "adjugate": "|D|D⁻¹"}.get(metric, metric)
    if boundary := settings.get("boundary"):
        facts["boundary"] = boundary if isinstance(boundary, str) else json.dumps(boundary)
    if result.eigenvalues.size and settings.get("method", "spectral") == "spectral":
        facts["eigenpairs"] = len(result.eigenvalues)
    return facts
