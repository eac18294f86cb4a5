"""What a job leaves in its folder: all of it or nothing."""

import argparse
import importlib.metadata
import json
import math
import os
import platform
import sys
import zipfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from hks_jax.atomic import atomic_folder
from hks_jax.cli.job import Result
from hks_jax.cli.progress import Progress
from hks_jax.io.save import save
from hks_jax.io.volume import TensorVolume

SIGNATURE = "hks"
"""How the names of a signature's files begin."""
REPORT = "report.json"
PAIRS = "pairs.npz"
"""The file of eigenpairs that were kept."""


def check_folder(path: Path) -> None:
    """Raise before a long computation if its results could not be written.

    Raises:
        NotADirectoryError: `path` is a file.
        PermissionError: it may not be written.
    """
    nearest = next(folder for folder in (path, *path.absolute().parents) if folder.exists())
    if not nearest.is_dir():
        raise NotADirectoryError(f"--output: {nearest} is a file; expected a folder, or a name that is free")
    if not os.access(nearest, os.W_OK | os.X_OK):
        raise PermissionError(f"--output: {nearest} may not be written; choose another folder")


def signature_file(result: Path) -> Path:
    """Return the file of the signature in a folder that `write_outputs` has written; a file is its own."""
    return result / f"{SIGNATURE}.npz" if result.is_dir() else result


def of_earlier(folder: Path, eigenvalues: np.ndarray, progress: Progress) -> list[Path]:
    """Return the files of an earlier signature in a folder and all that was made of it, which a new one takes away.

    Eigenpairs stay where they are those of the new signature, whose eigenvalues are given.
    """
    found, own = [], []
    if signature_file(folder).is_file():  # else what has these names is not ours
        regions = ("regions.json", "regions.tsv") if (folder / "regions.json").is_file() else ()
        own = [*folder.glob(f"{SIGNATURE}.*"), folder / REPORT]
        found = [*own, *(folder / name for name in ("explore.html", *regions) if (folder / name).is_file())]
    if not _are_pairs(folder / PAIRS, eigenvalues):
        found.append(folder / PAIRS)
    if derived := [file.name for file in found if file not in own]:
        progress.note(f"removed {', '.join(derived)} of an earlier signature in {folder}")
    return found


def _are_pairs(path: Path, eigenvalues: np.ndarray) -> bool:
    """Tell whether a file holds eigenpairs with just these eigenvalues, or is none of ours."""
    if not zipfile.is_zipfile(path):
        return True
    with np.load(path) as arrays:  # of which only the one is read
        return "eigenvalues" not in arrays or np.array_equal(arrays["eigenvalues"], eigenvalues)


def write_outputs(
    folder: Path, result: Result, progress: Progress, draw: Callable[[Path], Any], image: str
) -> list[Path]:
    """Write hks.npz, hks.png (by `draw`), report.json and, unless its suffix is empty, an image; return their paths."""
    stale = partial(of_earlier, folder, result.eigenvalues, progress)
    with writing(folder, result.report, progress, stale) as (temporary, files):
        origin = {"command": sys.argv, "settings": plain(result.report["settings"]), "times": result.times}
        save_result(temporary / SIGNATURE, result, image, origin)
        draw(temporary / f"{SIGNATURE}.png")
    return files


@contextmanager
def writing(
    folder: Path,
    report: dict[str, Any],
    progress: Progress,
    stale: Callable[[], Iterable[Path]] = tuple,
) -> Iterator[tuple[Path, list[Path]]]:
    """Yield a temporary folder, and a list that has the paths of the results at the end.

    At the end report.json is written beside the other files, and all of them move to `folder`, or none of them does.

    Args:
        folder: for the results.
        report: what report.json says.
        progress: what says that they are written.
        stale: returns the files of earlier results that the new ones take away.
    """
    files = list[Path]()
    with progress.stage("writing", str(folder)), atomic_folder(folder, stale) as temporary:
        yield temporary, files
        write_report(temporary / REPORT, report, progress)
        files += sorted(folder / file.name for file in temporary.iterdir())


def save_result(
    stem: Path, result: Result, image: str, origin: dict[str, Any], more: dict[str, Any] | None = None
) -> None:
    """Write a signature as `stem` with ``.npz`` after it and, unless it is empty, with the suffix of an image.

    The former also has the times, the eigenvalues, the tensors that the signature is of, to be shown beside it, the
    deviation, the bias and draws of its noise if they are known, and `more`.
    """
    values = as_precise_as_the_data(result)
    extra = {"times": result.times, "eigenvalues": result.eigenvalues, **(more or {})}
    if result.bars is not None:
        bars, maps = result.bars.uncertainty, result.bars.maps
        extra |= {"deviation": np.asarray(bars.deviation), "bias": np.asarray(bars.bias), "noise_maps": maps}
    for suffix in filter(None, (".npz", image)):
        given: dict[str, Any] = {"times": result.times} if suffix == ".nii.gz" else extra
        if suffix == ".npz" and isinstance(result.volume, TensorVolume):
            given = {**extra, "input_tensors": result.volume.tensors.astype(np.float32)}
        path = stem.with_name(stem.name + suffix)
        save(path, values, result.volume, name="hks", extra=given, provenance=origin)


def as_precise_as_the_data(result: Result) -> np.ndarray:
    """Return the signature in single precision if the tensors are: more digits mean nothing and take room."""
    single = isinstance(result.volume, TensorVolume) and result.volume.tensors.dtype == np.float32
    return result.values.astype(np.float32) if single else result.values


def write_report(path: Path, report: dict[str, Any], progress: Progress) -> None:
    """Write a report as JSON, with the command before it, and warnings, versions and seconds of each stage after it."""
    whole = {
        "command": sys.argv,
        **report,
        "warnings": progress.warnings,
        "versions": versions(),
        "seconds": {stage: round(seconds, 3) for stage, seconds in progress.timings.items()},
    }
    path.write_text(json.dumps(plain(whole), indent=2, ensure_ascii=False) + "\n")


def show_files(files: list[Path], quiet: bool, as_json: bool) -> None:
    """Print the files' names, or the report among them as JSON together with the names."""
    if as_json:
        (report,) = (file for file in files if file.name == REPORT)
        print(
            json.dumps({**json.loads(report.read_text()), "files": [str(file) for file in files]}, ensure_ascii=False)
        )
    elif not quiet:
        print("\n".join(map(str, files)))


def show_summary(args: argparse.Namespace, files: list[Path], summary: dict[str, Any]) -> None:
    """Print the files' names, or a summary as JSON together with the names, as the arguments ask."""
    if args.json:
        print(json.dumps(plain({**summary, "files": [str(file) for file in files]}), ensure_ascii=False))
    elif not args.quiet:
        print("\n".join(map(str, files)))


def versions() -> dict[str, str]:
    """Return the versions of what took part, and the device."""
    import jax

    versions = {
        "python": platform.python_version(),
        "system": platform.platform(),
        "device": jax.devices()[0].device_kind,
    }
    optional = "optimistix numpy scipy matplotlib nibabel dipy pynrrd vtk meshio"
    for package in ("hks-jax", "jax", "jaxlib", *optional.split()):
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return versions


def plain(value: Any) -> Any:
    """Return what JSON can hold: no NaN or infinity, no tuples or NumPy scalars."""
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
