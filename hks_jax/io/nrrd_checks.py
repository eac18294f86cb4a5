"""Check NRRD files for damage that pynrrd ignores: unknown fields, and incomplete compressed data."""

import bz2
import gzip
from collections.abc import Mapping
from pathlib import Path
from typing import Any

_FIELDS = frozenset(
    name
    for names in (
        "dimension, type, block size, blocksize, encoding, endian, content, min, max, old min, oldmin, old max, oldmax",
        "data file, datafile, line skip, lineskip, byte skip, byteskip, number, sample units, sampleunits, sizes",
        "spacings, thicknesses, axis mins, axismins, axis maxs, axismaxs, centers, centerings, labels, units, kinds",
        "space, space dimension, space units, space origin, space directions, measurement frame",
    )
    for name in names.split(", ")
)
"""All fields of the format (Teem, "Definition of NRRD File Format")."""

PATIENT = {
    "right-anterior-superior": (1.0, 1.0, 1.0),
    "left-anterior-superior": (-1.0, 1.0, 1.0),
    "left-posterior-superior": (-1.0, -1.0, 1.0),
}
"""The patient-based spaces, and the signs that transform them to right, anterior, superior, NIfTI's axes."""

_SHORT = {"".join(word[0] for word in name.split("-")): name for name in PATIENT}
_SPACES = (*PATIENT, "scanner-xyz", "3d-right-handed", "3d-left-handed")

_PER_AXIS = ("sizes", "spacings", "thicknesses", "kinds", "space directions")
_OPENED: dict[str, Any] = {"gzip": gzip.open, "gz": gzip.open, "bzip2": bz2.open, "bz2": bz2.open}


def check_header(text: bytes, header: Mapping[str, Any]) -> None:
    """Raise ValueError for a line that is neither a field of the format nor a key, and for a field of wrong length.

    Without this check, a field with a damaged name would be ignored and have its default, such as a spacing of one.
    """
    for line in text.splitlines()[1:]:
        if line.startswith(b"#") or not line:
            continue
        key, colon, value = line.partition(b":")
        name, is_key = key.decode("latin-1"), value.startswith(b"=")
        if not colon or (name in _FIELDS) == is_key or (not is_key and not line.isascii()) or b"\0" in line:
            raise ValueError(f"got the header line {line[:60]!r}; expected a field of the format, or a key and a value")
    n = int(header["dimension"])
    for name in _PER_AXIS:
        if name in header and len(header[name]) != n:
            raise ValueError(f"{name}: got {len(header[name])} entries; expected {n}, one per axis")
    space_of(header)


def space_of(header: Mapping[str, Any]) -> str:
    """Return the full name of the space in lower case, without its time axis, or the empty text."""
    space = str(header.get("space", "")).lower()
    name = _SHORT.get(space.removesuffix("t"), space.removesuffix("-time"))
    if "space" in header and name not in _SPACES:
        raise ValueError(f"space: got {space!r}; expected a space of the format, such as left-posterior-superior")
    return name


def check_data(file: Path, header: Mapping[str, Any], start: int) -> None:
    """Raise an error if compressed data are incomplete or fail their checksum; pynrrd compares the length of others."""
    opened = _OPENED.get(str(header["encoding"]).lower())
    if opened is None:
        return
    beside = header.get("data file", header.get("datafile"))
    with open(file if beside is None else file.parent / str(beside), "rb") as source:
        source.seek(start if beside is None else 0)
        for _ in range(int(header.get("line skip", header.get("lineskip", 0)))):
            source.readline()
        with opened(source) as content:
            content.read()
