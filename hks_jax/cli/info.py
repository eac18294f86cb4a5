"""``hks-jax info FILE``: what is in a file of tensors, or a mesh, and which k and t would suit it."""

import argparse
import json
import math
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from hks_jax.cli.arguments import DEFAULT_K, RESOLVED
from hks_jax.cli.progress import Progress
from hks_jax.cli.reading import add_arguments, read
from hks_jax.domain.simplices import WORDS, signed_measure
from hks_jax.eigen.weyl import weyl, weyl_number
from hks_jax.io import TensorVolume, find_invalid, read_mesh
from hks_jax.io.mesh import READ as MESHES
from hks_jax.io.mesh import is_mesh
from hks_jax.io.provenance import digest
from hks_jax.io.repair import find_unsymmetric

DESCRIPTION = f"""\
Say what is in a file of tensors: shape, order of components and how it was determined, frame, mask and its pieces,
eigenvalues, tensors that are not positive definite, and the k and t that would suit. Of a mesh of triangles or
tetrahedra ({", ".join(MESHES)}, or a surface of FreeSurfer's): size, boundary, pieces, and the same.
"""

EPILOG = """\
examples:
  hks-jax info tensor.nii.gz --mask mask.nii.gz
  hks-jax info dti.nrrd --slice z=14 --json
"""

COARSE = 6.0
"""t/h² from which the grid's spacing h biases it by at most 1 %."""


def add_parser(subparsers: Any) -> argparse.ArgumentParser:
    """Add the subcommand's parser."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "info",
        help="say what is in a file, and which k and t would suit it",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_arguments(parser)
    parser.add_argument("--json", action="store_true", help="print JSON")
    return parser


def run(args: argparse.Namespace) -> None:
    """Run the subcommand."""
    progress = Progress(quiet=True)
    with progress.catching_warnings():
        found = describe_mesh(args.file) if is_mesh(args.file) else describe(args.file, read(args, progress))
    if args.json:
        print(json.dumps(found, indent=2, ensure_ascii=False))
    else:
        print("\n".join(_lines(found)))


def describe(path: Path, volume: TensorVolume) -> dict[str, Any]:
    """Return what there is to say of a volume, in plain numbers."""
    from hks_jax.domain.components import label_nodes

    inside, bad = volume.inside, find_invalid(volume)
    good = inside & ~bad
    labels, count = label_nodes(inside, (False,) * volume.dimension)
    found: dict[str, Any] = {
        "file": str(path),
        "sha256": volume.digest,
        "format": "".join(path.suffixes[-2:] if path.suffix == ".gz" else path.suffixes[-1:]),
        "dtype": volume.tensors.dtype.name,
        "shape": list(volume.shape),
        "spacing": list(volume.spacing),
        "order": volume.order,
        "frame": volume.frame,
        "affine": None if volume.affine is None else volume.affine.tolist(),
        "notes": list(volume.notes),
        "inside": int(inside.sum()),
        "masked": volume.mask is not None,
        "components": count,
        "component_sizes": np.sort(np.bincount(labels.ravel())[1:])[::-1][:10].tolist(),
        "not_positive_definite": int(bad.sum()),
        "not_symmetric": int(find_unsymmetric(volume).sum()),
    }
    if good.any():
        tensors = volume.tensors[good].astype(np.float64)
        values = np.linalg.eigvalsh(0.5 * (tensors + np.swapaxes(tensors, -1, -2)))
        found["eigenvalues"] = {"least": float(values.min()), "median": float(np.median(values))}
        found["eigenvalues"]["largest"] = float(values.max())
        found["median_mean_diffusivity"] = float(np.median(values.mean(axis=-1)))
        metrics = {"inverse": np.linalg.inv(tensors), "tensor": tensors}
        found["suits"] = {
            name: _suits(g, np.array(volume.spacing), volume.shape, inside.sum() / good.sum())
            for name, g in metrics.items()
        }
    return found


def describe_mesh(path: Path) -> dict[str, Any]:
    """Return what there is to say of a mesh."""
    mesh = read_mesh(path)
    vertices, cells, d = np.asarray(mesh.vertices, np.float64), mesh.triangulation.cells, mesh.triangulation.dimension
    words = WORDS[d]
    measure = float(np.sum(signed_measure(vertices, cells)[0])) / math.factorial(d)
    sides = [vertices[cells[:, i]] - vertices[cells[:, j]] for i, j in combinations(range(d + 1), 2)]
    edge = float(np.median(np.linalg.norm(np.concatenate(sides), axis=1)))
    size = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    return {
        "file": str(path),
        "sha256": digest(path),
        "format": path.suffix,
        "vertices": len(vertices),
        words.simplices: len(cells),
        "boundary_vertices": int(mesh.triangulation.boundary_vertices.sum()),
        "components": mesh.triangulation.labels[1],
        words.measure: measure,
        "median_edge": edge,
        "suits": {{2: "surface", 3: "solid"}[d]: _times(d, measure, edge**2, size, len(vertices))},
    }


def _suits(
    metric: Float[np.ndarray, "n d d"], spacing: Float[np.ndarray, " d"], shape: tuple[int, ...], share: float
) -> dict[str, float]:
    """Return the times and k for the metric at the valid voxels, which are one part in `share` of the domain."""
    d = len(spacing)
    along = np.einsum("naa->na", metric) * spacing**2  # squared distances of neighbours, per axis
    volume = float(np.sqrt(np.linalg.det(metric)).sum() * np.prod(spacing) * share)
    size = float(np.sqrt((np.median(along, axis=0) * np.array(shape) ** 2).max()))
    return _times(d, volume, float(np.median(along.max(axis=1))), size, round(len(metric) * share))


def _times(d: int, volume: float, width2: float, size: float, nodes: int) -> dict[str, float]:
    """Return the least time that the spacing allows, what k it takes, what the default k allows, and the largest."""
    least = COARSE * width2
    k = max(1, min(DEFAULT_K[d], nodes // 4))
    return {
        "least_time": least,
        "k_for_least_time": math.ceil(weyl_number(RESOLVED[d] / least, volume, d)),
        "k": k,
        "least_time_of_k": RESOLVED[d] / weyl(k, volume, d),
        "largest_time": 4 * np.log(10) * (size / np.pi) ** 2,  # 4 ln 10 / λ₁ of an interval of this length
    }


def _lines(found: dict[str, Any]) -> list[str]:
    """Return the description as lines of text."""

    def numbers(values: Any) -> str:
        return " × ".join(f"{v:.5g}" for v in values)

    lines = [f"{found['file']}: {found['format']}, SHA-256 {found['sha256'][:16]}…"]
    words = next((words for words in WORDS.values() if words.simplices in found), None)
    if words is not None:
        lines += [
            f"mesh            {found['vertices']} vertices, {found[words.simplices]} {words.simplices}",
            f"boundary        {found['boundary_vertices']} vertices",
            f"components      {found['components']}",
            f"{words.measure:<16}{found[words.measure]:.5g}",
            f"median edge     {found['median_edge']:.5g}",
        ]
    else:
        bad, sizes = found["not_positive_definite"], ", ".join(map(str, found["component_sizes"]))
        placed = "without an affine" if found["affine"] is None else "placed by an affine"
        lines += [
            f"tensors         {numbers(found['shape'])}, {found['dtype']}, {placed}",
            f"spacing         {numbers(found['spacing'])}",
            f"order, frame    {found['order']}, {found['frame']} axes",
            *(f"                {note}" for note in found["notes"]),
            f"inside          {found['inside']} voxels{'' if found['masked'] else ' (no mask)'}",
            f"components      {found['components']} ({sizes} nodes)",
            f"invalid         {bad} tensors are not positive definite" + (": see --repair" if bad else ""),
        ]
        if found["not_symmetric"]:
            lines.append(f"                {found['not_symmetric']} tensors are not symmetric")
    if "eigenvalues" in found:
        e = found["eigenvalues"]
        lines += [
            f"eigenvalues     {e['least']:.3g} … {e['largest']:.3g}, median {e['median']:.3g}",
            f"diffusivity     {found['median_mean_diffusivity']:.3g}, the median of the tensors' mean eigenvalues",
        ]
    for name, s in found.get("suits", {}).items():
        lines += [
            f"metric {name:<8} t ≥ {s['least_time']:.3g} by the spacing (to 1 %; takes k ≈ {s['k_for_least_time']}); "
            f"t ≥ {s['least_time_of_k']:.3g} by k = {s['k']}; t ≤ {s['largest_time']:.3g} by the size"
        ]
    return lines
