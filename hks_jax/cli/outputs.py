"""Write the files of a command, all or none, then its pictures, and print its summary."""

import argparse
import importlib.metadata
import json
import os
import platform
import sys
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hks_jax.cli.progress import Progress
from hks_jax.io.json_files import plain, write_json
from hks_jax.io.result import Result
from hks_jax.storage import atomic_folder, atomic_path

REPORT = "report.json"
PAIRS = "pairs.npz"
"""The name of the file of saved eigenpairs."""
_VTK = (".vtu", ".vtk", ".vti")
"""The suffixes of VTK's files, which ParaView opens."""
_OPTIONAL = ("nibabel", "dipy", "pynrrd", "vtk", "meshio")


class PictureError(RuntimeError):
    """The error for a picture that cannot be drawn, although the results are complete."""


class Done(NamedTuple):
    """The output of a command: its files, a summary for JSON, and a text to print in place of the files' names."""

    files: list[Path]
    summary: dict[str, Any]
    text: str | None = None


def show(args: argparse.Namespace, done: Done) -> None:
    """Print the output of a command in the form that the arguments choose."""
    names = list(map(str, done.files))
    if args.json:
        print_output(json.dumps(plain({**done.summary, "files": names}), ensure_ascii=False))
    elif not args.quiet:
        print_output("\n".join(names) if done.text is None else done.text)


def print_output(text: str) -> None:
    """Print the output of a command, unless its reader, such as the program head, has ended."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python flushes the output again as it ends


@contextmanager
def writing(
    folder: Path,
    report: Mapping[str, Any],
    progress: Progress,
    stale: Callable[[], Iterable[Path]] = tuple,
    pictures: Mapping[str, Callable[[Path], Any]] | None = None,
) -> Iterator[tuple[Path, Done]]:
    """Yield a temporary folder and a `Done`, to which the report and the paths of the results are added at the end.

    At the end, report.json is also written, all files are moved to `folder` atomically, and `stale` files are deleted.
    The functions in `pictures`, by name of the file, draw afterwards, so that a failure leaves the results.
    """
    pictures, summary = pictures or {}, dict[str, Any]()
    done = Done([], summary)

    def replaced() -> Iterable[Path]:
        return {*stale(), *(folder / name for name in pictures)}

    with progress.stage("writing", str(folder)), atomic_folder(folder, replaced) as temporary:
        yield temporary, done
        seconds = {stage: round(spent, 3) for stage, spent in progress.timings.items()}
        known = {"warnings": list(progress.warnings), "versions": versions(), "seconds": seconds}
        summary |= {"command": sys.argv, **report, **known}
        write_json(temporary / REPORT, summary)
        done.files.extend(folder / file.name for file in temporary.iterdir())
    said = len(progress.warnings)
    for name, draw in pictures.items():
        with progress.stage("drawing", str(folder / name)):
            draw_picture(folder / name, draw, done.files)
        done.files.append(folder / name)
    done.files.sort()
    if len(progress.warnings) > said:
        summary["warnings"] = list(progress.warnings)
        write_json(folder / REPORT, summary)


def draw_picture(path: Path, draw: Callable[[Path], Any], results: Iterable[Path]) -> None:
    """Draw a picture of complete results; raise PictureError with the names of the results if this fails."""
    try:
        with atomic_path(path) as temporary:
            draw(temporary)
    except Exception as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        names = ", ".join(sorted(map(str, results)))
        raise PictureError(
            f"the picture {path} cannot be drawn ({reason}). The results are complete: {names}"
        ) from error


def write_outputs(
    folder: Path,
    result: Result,
    progress: Progress,
    draw: Callable[[Path], Any],
    *images: str,
    origin: Mapping[str, Any] | None = None,
) -> Done:
    """Write hks.npz, report.json, and images of the given suffixes unless they are empty; then hks.png, by `draw`.

    The entries of `origin` are added to the provenance. Beside files of VTK, the times are also written as a series.
    """
    series = (".pvd",) if len(result.times) > 1 and any(suffix in _VTK for suffix in images) else ()
    stale = partial(of_earlier, folder, result.eigenvalues, progress)
    with writing(folder, result.report, progress, stale, {"hks.png": draw}) as (temporary, done):
        result.save(temporary / "hks", *images, *series, origin={"command": sys.argv, **(origin or {})})
    return done


def of_earlier(folder: Path, eigenvalues: np.ndarray, progress: Progress) -> list[Path]:
    """Return the files of an earlier signature in a folder, without saved eigenpairs that have equal eigenvalues."""
    found, own, pairs = [], [], folder / PAIRS
    if (folder / "hks.npz").is_file():  # without a signature, other programs wrote the files
        regions = ("regions.json", "regions.tsv") if (folder / "regions.json").is_file() else ()
        own = [*folder.glob("hks.*"), folder / REPORT]
        found = [*own, *(folder / name for name in ("explore.html", *regions) if (folder / name).is_file())]
    if zipfile.is_zipfile(pairs):
        with np.load(pairs) as arrays:  # reads only the array that is used
            if "eigenvalues" in arrays and not np.array_equal(arrays["eigenvalues"], eigenvalues):
                found.append(pairs)
    if derived := [file.name for file in found if file not in own]:
        progress.note(f"removed {', '.join(derived)} of an earlier signature in {folder}")
    return found


def versions() -> dict[str, str]:
    """Return the versions of Python, the system and the libraries, and the device."""
    import jax

    python, system, device = platform.python_version(), platform.platform(), jax.devices()[0].device_kind
    versions = {"python": python, "system": system, "device": device}
    for package in ("hks-jax", "jax", "jaxlib", "optimistix", "numpy", "scipy", "matplotlib", *_OPTIONAL):
        with suppress(importlib.metadata.PackageNotFoundError):
            versions[package] = importlib.metadata.version(package)
    return versions
