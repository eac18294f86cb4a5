"""What a release must hold: ``python tests/distribution.py dist`` looks into the wheel and the sources there."""

import sys
import tarfile
import zipfile
from email.parser import Parser
from pathlib import Path

ROOT = Path(__file__).parents[1]
SOURCES = (
    "README.md",
    "LICENSE",
    "CHANGELOG.md",
    "CITATION.cff",
    "CONTRIBUTING.md",
    "Makefile",
    "mkdocs.yml",
    "references.bib",
    ".ci/run",
    *("containers", "docs", "notebooks", "tests", "benchmarks", "hks_jax"),
)
NO_SOURCES = {".pyc", ".part"}


def files_of(folder: Path) -> set[str]:
    """Return the files of a folder of the repository, without what running it leaves behind."""
    paths = (path for path in ([folder] if folder.is_file() else folder.rglob("*")) if path.is_file())
    return {path.relative_to(ROOT).as_posix() for path in paths if path.suffix not in NO_SOURCES}


def wheel_differences(wheel: Path) -> list[str]:
    """Return what is wrong with a wheel: its files are those of the package and its metadata, and no others."""
    with zipfile.ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if not name.endswith("/")}
        (metadata,) = (name for name in names if name.endswith(".dist-info/METADATA"))
        text = archive.read(metadata).decode("utf-8")
    info = metadata.rpartition("/")[0]
    held = {"METADATA", "WHEEL", "RECORD", "entry_points.txt", "licenses/LICENSE"}
    expected = files_of(ROOT / "hks_jax") | {f"{info}/{name}" for name in held}
    found = [f"{wheel.name} lacks {name}" for name in sorted(expected - names)]
    found += [f"{wheel.name} holds {name}, which it should not" for name in sorted(names - expected)]
    fields = Parser().parsestr(text)
    found += [f"{wheel.name} has no field {name}" for name in ("Project-URL", "License-Expression") if not fields[name]]
    description = fields.get_payload()
    assert isinstance(description, str)
    if "# hks_jax" not in description or "](docs/" in description:
        found.append(f"{wheel.name}: the description is not README.md with absolute links")
    return found


def source_differences(sources: Path) -> list[str]:
    """Return what an archive of the sources lacks."""
    with tarfile.open(sources) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    expected = set().union(*(files_of(ROOT / part) for part in SOURCES))
    return [f"{sources.name} lacks {name}" for name in sorted(expected - names)]


def main(folder: str) -> None:
    """Tell what is wrong with the archives in a folder, and fail if anything is."""
    (wheel,), (sources,) = sorted(Path(folder).glob("*.whl")), sorted(Path(folder).glob("*.tar.gz"))
    if found := [*wheel_differences(wheel), *source_differences(sources)]:
        sys.exit("\n".join(["error: not what a release holds:", *found]))
    print(f"{wheel.name} and {sources.name} hold what they should")


if __name__ == "__main__":
    main(sys.argv[1])
