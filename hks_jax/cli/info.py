"""Describe the content of a file, with suitable k and t.

Describe a file of tensors: the shape, the order of the components and its source, the frame, the units, the mask and
its connected components, the eigenvalues, the number of tensors that are not positive definite, and suitable k and t.
The command also asks questions if the frame or a unit looks wrong. For a mesh of triangles or tetrahedra
({meshes}, or a FreeSurfer surface), it gives the size, the boundary, the connected components, the arrays at vertices
and cells, and suitable k and t.
For saved eigenpairs, it gives their number and settings. For a result of another command, it gives the times and
settings, and the commands that draw the result.

examples:
  hks-jax info tensor.nii.gz --mask mask.nii.gz
  hks-jax info dti.nrrd --slice z=14 --json
"""

import argparse
import json
import math
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hks_jax.cli import options
from hks_jax.cli.computation import times_in_words
from hks_jax.cli.meshes import describe_mesh
from hks_jax.cli.outputs import print_output
from hks_jax.cli.pairs import arrays_in, facts_of, is_saved_pairs
from hks_jax.cli.progress import Progress
from hks_jax.cli.reading import Reading, outside_note, read, without_element
from hks_jax.domain.components import label_nodes
from hks_jax.domain.tensor_checks import MANY, unsymmetric
from hks_jax.fem.boundary import BoundarySpec, default_boundary
from hks_jax.io import TensorVolume
from hks_jax.io.mesh import is_mesh, load_mesh
from hks_jax.io.repair import invalid_in
from hks_jax.io.result import NAMES, Result, signature_file
from hks_jax.io.units import MEDIAN, MM2_PER_S, by_axis, is_plausible, unit_of_times
from hks_jax.naming import with_option
from hks_jax.signatures.times import FREE, suitable

USAGE = "FILE"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    options.add_file(parser)
    options.add_reading(parser)
    options.add_clean(parser)


def run(args: argparse.Namespace, progress: Progress) -> None:
    """Run the command."""
    progress.quiet, questions = True, list[str]()
    result = _result_of(args.file)
    if args.others and (result is not None or is_mesh(args.file)):
        raise ValueError(f"FILE: got {1 + len(args.others)} files; expected one result or mesh")
    if result is not None:
        description = _describe_result(result)
    elif is_saved_pairs(args.file):
        use = f"hks-jax hks {shlex.quote(str(args.file))} -o OUT --times auto:8"
        description = {"file": str(args.file), **facts_of(args.file), "for a signature": use}
    elif is_mesh(args.file):
        found = load_mesh(args.file, args.clean)
        description = {"file": str(args.file), **describe_mesh(args.file, found.mesh), "arrays": listed(found.arrays)}
    else:
        description = {
            **describe(args.file, read(Reading.of(args), progress, questions.append)),
            "questions": questions,
        }
    text = json.dumps(description, indent=2, ensure_ascii=False) if args.json else "\n".join(_lines(description))
    print_output(text)


def _result_of(path: Path) -> Result | None:
    """Return the result in an npz, in the npz of a folder, or in the npz beside an image; None for other files."""
    file = signature_file(path) if path.is_dir() else Path(str(path).removesuffix(".gz")).with_suffix(".npz")
    return Result.read(file) if arrays_in(file).intersection(NAMES) else None


def _describe_result(result: Result) -> dict[str, Any]:
    source = shlex.quote(result.source)
    facts = {
        "file": result.source,
        "result": {"hks": "heat kernel signature", "curvature": "Gaussian curvature"}[result.name],
        "shape": result.values.shape[1:],
        "inside": int(np.isfinite(result.values[0]).sum()),
        **{name: value for name, value in result.settings.items() if value},
        "times": times_in_words(result.times, result.lengths, result.unit, result.length_unit),
        "D": "" if result.diffusivity is None else f"{result.diffusivity:.3g}, {MEDIAN}",
        "near the rim": _shares(result),
    }
    on_grid = isinstance(result.place, TensorVolume)
    if on_grid:
        facts["to draw it"] = f"hks-jax plot {source} -o picture.png"
    if result.name == "hks":
        facts["to explore it"] = f"hks-jax explore {source}"
        command, labels = ("stats", "atlas") if on_grid else ("explore", "labels")
        facts["for regions"] = f"hks-jax {command} {source} --{labels} LABELS"
    return facts


def _shares(result: Result) -> str:
    """Return the share of nodes at each time at which the boundary contributes over a tenth, in words, if known."""
    if result.near_rim is None:
        return ""
    nodes = np.isfinite(result.values[0]).sum()
    shares = result.near_rim.reshape(len(result.times), -1).sum(axis=1) / nodes
    return ", ".join(f"{100 * share:.0f} %" for share in shares) + f" of the nodes (influence over {100 * FREE:.0f} %)"


def describe(path: Path, volume: TensorVolume, boundary: BoundarySpec | None = None) -> dict[str, Any]:
    """Return facts about a volume for JSON. If `boundary` is None, `default_boundary` determines suitable k and t."""
    inside, found = volume.inside, invalid_in(volume)
    bad = found.bad
    boundary = default_boundary(inside)[0] if boundary is None else boundary
    good = inside & ~bad
    labels, count = label_nodes(inside, (False,) * volume.dimension)
    description: dict[str, Any] = {
        "file": str(path),
        "sha256": volume.digest,
        "format": "".join(path.suffixes[-2:] if path.suffix == ".gz" else path.suffixes[-1:]),
        "dtype": volume.tensors.dtype.name,
        **{name: getattr(volume, name) for name in ("shape", "spacing", "length_unit", "unit", "order", "frame")},
        "affine": None if volume.affine is None else volume.affine.tolist(),
        "notes": volume.notes,
        "inside": int(inside.sum()),
        "masked": volume.mask is not None,
        "components": count,
        "without_element": int(without_element(volume).sum()),
        "boundary": boundary,
        "component_sizes": np.sort(np.bincount(labels.ravel())[1:])[::-1][:10].tolist(),
        "not_positive_definite": int((bad & ~found.singular).sum()),
        "nearly_singular": int(found.singular.sum()),
        "least_admissible_eigenvalue": found.floor,
        "not_symmetric": int((inside & unsymmetric(volume.tensors)).sum()),
    }
    wrong = volume.invalid_by_order
    if bad.any() and wrong is not None and wrong.fewer:
        description |= {"invalid_by_order": wrong.counts, "question": wrong.question}
    if good.any():
        tensors = volume.tensors[good].astype(np.float64)
        values = np.linalg.eigvalsh(0.5 * (tensors + np.swapaxes(tensors, -1, -2)))
        ends = {"least": values.min(), "median": np.median(values), "largest": values.max()}
        description["eigenvalues"] = {name: float(value) for name, value in ends.items()}
        description["median_mean_diffusivity"] = float(np.median(values.mean(axis=-1)))
    # If many tensors are invalid, suitable k and t cannot be computed.
    if count and good.any() and bad.sum() <= MANY * inside.sum():
        metrics = {"inverse": np.linalg.inv(tensors), "tensor": tensors}
        description["suits"] = {name: suitable(g, volume.spacing, inside, boundary) for name, g in metrics.items()}
        description["time_units"] = {name: unit_of_times(volume, name) for name in metrics}
    return description


def listed(arrays: Mapping[str, Mapping[str, np.ndarray]]) -> list[dict[str, Any]]:
    """Return the names, places and numbers of components of a mesh's arrays."""
    return [
        {"name": name, "at": at, "components": math.prod(values.shape[1:])}
        for at, named in arrays.items()
        for name, values in named.items()
    ]


def _plain(value: Any) -> str:
    if isinstance(value, list | tuple):
        return ", ".join(map(_plain, value))
    return f"{value:.5g}" if isinstance(value, float) else str(value)


def _lines(description: dict[str, Any]) -> list[str]:
    if "sha256" not in description:  # a result has no digest
        return [f"{name:<16}{_plain(value)}" for name, value in description.items() if value]
    lines = [f"{description['file']}: {description['format']}, SHA-256 {description['sha256'][:16]}…"]
    if "vertices" in description:
        left_out = ("file", "format", "sha256", "suits", "arrays")
        facts = {name.replace("_", " "): value for name, value in description.items() if name not in left_out}
        lines += [f"{name:<18}{_plain(value)}" for name, value in facts.items()]
        for array in description.get("arrays", ()):
            use = "; to use its tensors, pass --array and --metric to hks-jax hks" * (array["components"] in (6, 9))
            lines.append(
                f"array             {array['name']} at the {array['at']}, components: {array['components']}{use}"
            )
    else:
        bad, sizes = description["not_positive_definite"], ", ".join(map(str, description["component_sizes"]))
        singular, least = description["nearly_singular"], description["least_admissible_eigenvalue"]
        length = f" {description['length_unit']}" if description["length_unit"] else ", without a declared unit"
        placed = "without an affine" if description["affine"] is None else "with an affine"
        lines += [
            f"tensors         {by_axis(description['shape'])}, {description['dtype']}, {placed}",
            f"spacing         {by_axis(description['spacing'])}{length}",
            f"order, frame    {description['order']}, {description['frame']} axes",
            *(f"                {with_option(note)}" for note in description["notes"]),
            f"inside          {description['inside']} voxels{'' if description['masked'] else ' (no mask)'}",
            f"components      {description['components']}{f' ({sizes} nodes)' if sizes else ': the domain is empty'}",
            f"boundary        {description['boundary']} by default"
            f"{', with k eigenpairs for two problems together' * (description['boundary'] == 'mean')}",
        ]
        if description["without_element"]:
            lines.append(f"                {outside_note(description['without_element'])}")
        lines.append(f"invalid         {bad} tensors are not positive definite")
        if "question" in description:
            lines.append(f"                {description['question']}")
        elif bad > MANY * description["inside"]:
            lines.append(
                "                noise does not explain this; for naturally indefinite tensors, see --positive"
            )
        elif bad:
            lines[-1] += ": see --repair"
        if singular:
            lines.append(
                f"                {singular} tensors are nearly singular, with an eigenvalue below {least:.3g}, a "
                "hundredth of the median mean diffusivity, which no tissue has: see --repair"
            )
        if bad or singular:
            lines.append("                k and t below are those of the other tensors")
        if description["not_symmetric"]:
            lines.append(f"                {description['not_symmetric']} tensors are not symmetric")
    in_mm, unit = description.get("length_unit") == "mm", description.get("unit", "")
    if in_mm and not unit:
        known = is_plausible(description.get("median_mean_diffusivity", 0.0))
        unit = f"{MM2_PER_S} (assumed)" if known else "(unit not declared)"
    if "eigenvalues" in description:
        e = description["eigenvalues"]
        lines += [
            f"eigenvalues     {e['least']:.3g} … {e['largest']:.3g}, median {e['median']:.3g} {unit}".rstrip(),
            f"diffusivity     {description['median_mean_diffusivity']:.3g} {unit}".rstrip()
            + ", the median of the tensors' mean eigenvalues, the D of √(Dt)",
        ]
    lines += [f"question        {question}" for question in description.get("questions", ())]
    for name, s in description.get("suits", {}).items():
        worth = s["k_for_least_time"] <= s["unknowns"] / 4
        takes = f"k ≈ {s['k_for_least_time']}" if worth else "too many eigenpairs; see --method auto"
        keys = ("least_time", "least_time_of_k", "largest_time")
        length = "" if name != "inverse" else f" {description['length_unit'] or ''}".rstrip()
        mean = description.get("median_mean_diffusivity") if name == "inverse" else None
        lengths = None if mean is None else [math.sqrt(mean * s[key]) for key in keys]
        unit_of_t = description.get("time_units", {}).get(name, "")
        first, own, last = times_in_words([s[key] for key in keys], lengths, unit_of_t, length.strip())
        rim, size = "about half of the nodes are free of the boundary", "√t is half of the largest extent"
        lines.append(
            f"metric {name:<8} t ≥ {first} for a discretisation error of 1 % (needs {takes}); t ≥ {own} for "
            f"k = {s['k']}; t ≤ {last}, at which {rim if s['largest_time'] < s['time_by_size'] else size}"
            + ". No t satisfies both: the domain has too few nodes"
            * (s["largest_time"] < s["least_time"])
        )
        if name == "inverse":
            lines.append("operator fick   the same t and k as for the metric inverse")
    return lines
