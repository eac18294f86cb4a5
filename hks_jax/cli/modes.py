"""Compute the modes of a domain, and decompose maps into them.

Compute the eigenfunctions of the Laplace-Beltrami operator, or of Fick's operator: the modes of the tissue. FILE is
read as in 'hks-jax hks': tensors of a volume or a slice, a mesh, or eigenpairs written by 'hks-jax hks --save-pairs'.

The command writes to the folder OUT: modes.npz, and the modes in FILE's format (for NIfTI, along the fourth axis of
modes.nii.gz; for a GIFTI or FreeSurfer surface, modes.vtu and modes.func.gii); modes.json and modes.tsv with the
eigenvalues, and with the wavelengths and widths for which the modes stand; modes.png; and report.json.

With --map, the command also writes coefficients.tsv, with a column for each map, in the inner product of the domain's
mass; energies.tsv, the energy in each mode and the share of variance that the modes up to it explain, both as means
over the maps; and reconstruction.npz and an image, the projections of the maps onto the modes. The picture then also
shows the energies by wavelength, and the first map through a few numbers of modes.

The default boundary condition is neumann even for a mask, because with mean half of the modes are odd, and no map has a
part in them.

examples:
  hks-jax modes tensor.nii.gz -o out --mask mask.nii.gz --operator fick -k 200
  hks-jax modes tensor.nii.gz -o out --operator fick -k 200 --map bold.nii.gz
  hks-jax modes lh.white -o out --inside lh.cortex.label -k 200 --map lh.thickness
  hks-jax modes out/pairs.npz -o out --map bold.nii.gz
"""

import argparse
import math
from collections.abc import Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from hks_jax import ModeEnergies, energy, reconstruct
from hks_jax.cli import options
from hks_jax.cli.computation import OfMesh, OfVolume, compute_pairs, describe_pairs
from hks_jax.cli.outputs import REPORT, Done, writing
from hks_jax.cli.progress import Progress
from hks_jax.cli.source import read_source
from hks_jax.domain.simplicial_mesh import SimplicialMesh
from hks_jax.io import TensorVolume, read_maps, save
from hks_jax.io.cortex import MAPS
from hks_jax.io.formats import WRITTEN
from hks_jax.io.json_files import write_json
from hks_jax.io.mesh import WRITTEN as MESHES_WRITTEN
from hks_jax.io.mesh import is_surface
from hks_jax.io.nifti import REPETITION_TIME, repetition_time
from hks_jax.io.tables import write_table
from hks_jax.signatures.modes import lengths_of

USAGE = "FILE -o OUT"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    options.add_file(parser)
    options.add_metric(parser)
    options.add_reading(parser)
    options.add_output(parser)
    options.add_solving(parser)
    options.add_meshes(parser)
    parser.add_argument(
        "--map",
        type=Path,
        metavar="FILE",
        help="a map or a series of maps (4D): NIfTI, MRtrix, NRRD or .npy on the voxels of FILE; for a mesh GIFTI, "
        "FreeSurfer's maps (lh.thickness, lh.curv, …), .npy, or a mesh with arrays, one value per vertex. NaN marks "
        "unmeasured voxels or vertices: the modes are fitted to the others by least squares. Zeros are values. Values "
        "outside the mask are not used",
    )
    options.add_view(parser)


TABLES = ("modes.tsv", "modes.json", "coefficients.tsv", "energies.tsv")


def writes(args: argparse.Namespace) -> list[Path]:
    """Return the files that the command may write."""
    names = [*TABLES, REPORT, "modes.*", *["reconstruction.*"] * (args.map is not None)]
    return [args.output / name for name in names]


def run(args: argparse.Namespace, progress: Progress) -> Done:
    """Run the command."""
    domain, settings, saved = read_source(args, progress, "neumann")
    solved = saved or compute_pairs(domain, settings, progress)
    place, pairs, maps = domain.place, solved.pairs, None
    unit = place.length_unit if isinstance(place, TensorVolume) else "mm" * is_surface(args.file)
    if len(pairs.problems) > 1:
        odd = int((np.asarray(pairs.problem_numbers) > 0).sum())
        progress.note(
            f"{odd} of {pairs.k} modes are odd, and maps have no part in them; --boundary neumann has no odd modes"
        )
    if args.map is not None:
        with progress.stage("reading", str(args.map)):
            maps = read_maps(args.map, place)
    with progress.stage("modes"):
        functions = np.asarray(pairs.eigenfunctions)
        wavelength, fwhm = (np.asarray(lengths) for lengths in lengths_of(pairs))
        known = {"eigenvalue": np.asarray(pairs.eigenvalues), "wavelength": wavelength, "fwhm": fwhm}
        counts, shown, means = [], {}, {}
        if maps is not None:
            found = energy(pairs, maps)
            means, coefficients = _means(found), np.asarray(found.coefficients)
            projected = np.asarray(reconstruct(pairs, coefficients))
            counts = sorted({max(1, round(pairs.k**power)) for power in (1 / 3, 2 / 3, 1)})
            for n in counts:
                share = float(found.explained[0, n - 1])
                title = f"{'map 1, ' * (len(maps) > 1)}{n} modes" + f": {share:.0%}" * math.isfinite(share)
                shown[title] = np.asarray(reconstruct(pairs, coefficients[0, :n]))
            shown[args.map.name] = np.where(np.isfinite(functions[0]), maps[0], np.nan)
    report = {
        "input": domain.about,
        "settings": {**solved.settings.of_pairs, "k": pairs.k},
        "eigenpairs": describe_pairs(pairs),
        "units": {"length": unit or None},
        "map": None if maps is None else {"source": str(args.map), "maps": len(maps)},
    }
    style = {"wavelength": wavelength, "unit": unit, "view": args.view, **means}
    style |= {"counts": counts, "maps": shown}
    pictures = {"modes.png": partial(_draw, place, functions, style)}
    with writing(args.output, report, progress, lambda: _stale(args), pictures) as (folder, done):
        _write(folder, "modes", functions, domain, {"eigenvalues": np.asarray(pairs.eigenvalues)})
        _tabulate(folder / "modes.tsv", known)
        write_json(folder / "modes.json", _sidecar(domain, unit, known))
        if maps is not None:
            _write(folder, "reconstruction", projected, domain, repetition_time(args.map) if len(maps) > 1 else {})
            _tabulate(folder / "energies.tsv", known | means)
            _tabulate(folder / "coefficients.tsv", {f"map_{i + 1}": column for i, column in enumerate(coefficients)})
    return done


def _means(found: ModeEnergies) -> dict[str, np.ndarray]:
    """Return the means over the maps of the energies and of the shares of variance."""
    explained = np.asarray(found.explained)
    varies = np.isfinite(explained).all(axis=1)
    share = explained[varies].mean(axis=0) if varies.any() else np.full(explained.shape[1], np.nan)
    return {"energy": np.asarray(found.energy).mean(axis=0), "explained": share}


def _draw(place: TensorVolume | SimplicialMesh, modes: np.ndarray, style: Mapping[str, Any], path: Path) -> None:
    from hks_jax.plot.modes import modes_panels

    modes_panels(place, modes, path=path, **style)


def _tabulate(path: Path, columns: Mapping[str, np.ndarray]) -> None:
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    write_table(path, ["mode", *columns], [[i + 1, *row] for i, row in enumerate(rows)])


def _sidecar(domain: OfVolume | OfMesh, unit: str, known: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Return the sidecar of the modes; the infinite lengths of the eigenvalue 0 will be null."""
    return {
        "Quantity": "modes",
        "Description": "Eigenfunctions, orthonormal in the inner product of the mass matrix, in ascending order",
        "Eigenvalues": known["eigenvalue"],
        "Wavelengths": known["wavelength"],
        "FWHM": known["fwhm"],
        "LengthUnits": unit or "of the coordinates",
        "Sources": [Path(domain.about["source"]).name] if domain.about.get("source") else [],
    }


def _write(folder: Path, name: str, values: np.ndarray, domain: OfVolume | OfMesh, extra: Mapping[str, Any]) -> None:
    """Write modes or maps (m, *shape) as .npz and as images."""
    save(folder / f"{name}.npz", values, domain.place, name=name, extra=extra)
    for suffix in filter(None, domain.images):
        also = {n: array for n, array in extra.items() if n == REPETITION_TIME or not suffix.startswith(".nii")}
        stored = values.astype(np.float32)
        save(folder / f"{name}{suffix}", stored, domain.place, name=name, extra=also, provenance=domain.origin)


def _stale(args: argparse.Namespace) -> Iterable[Path]:
    """Return the files of an earlier call."""
    suffixes = (".npz", MAPS, *WRITTEN, *MESHES_WRITTEN)
    names = [f"{name}{suffix}" for name in ("modes", "reconstruction") for suffix in suffixes]
    return [args.output / name for name in (*TABLES, *names)]
