"""What pynrrd does not notice in a damaged NRRD file: fields that are none, and data that end early or late."""

import bz2
import math
import os
import zlib
from collections.abc import Mapping
from contextlib import ExitStack
from io import BufferedReader
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
"""All fields that the format has (Teem, "Definition of NRRD File Format")."""

PATIENT = {
    "right-anterior-superior": (1.0, 1.0, 1.0),
    "left-anterior-superior": (-1.0, 1.0, 1.0),
    "left-posterior-superior": (-1.0, -1.0, 1.0),
}
"""The spaces about a patient, and the signs that take them to right, anterior, superior, as NIfTI has them."""

_SHORT = {"".join(word[0] for word in name.split("-")): name for name in PATIENT}
_SPACES = (*PATIENT, "scanner-xyz", "3d-right-handed", "3d-left-handed")

_PER_AXIS = ("sizes", "spacings", "thicknesses", "kinds", "space directions")
_DECOMPRESSORS: dict[str, Any] = {
    **dict.fromkeys(("gzip", "gz"), lambda: zlib.decompressobj(zlib.MAX_WBITS | 16)),
    **dict.fromkeys(("bzip2", "bz2"), bz2.BZ2Decompressor),
}


def check_header(text: bytes, header: Mapping[str, Any]) -> None:
    """Raise ValueError for lines that are neither fields of the format nor keys, and for fields of another length.

    A field whose name is damaged would be passed over, and its default taken: a spacing of one, no frame.
    """
    for line in text.splitlines()[1:]:
        if line.startswith(b"#") or not line:
            continue
        key, colon, value = line.partition(b":")
        name, is_key = key.decode("latin-1"), value.startswith(b"=")
        if not colon or (name in _FIELDS) == is_key or (not is_key and not line.isascii()) or b"\0" in line:
            raise ValueError(f"the header's line {line[:60]!r} is neither a field of the format nor a key with a value")
    n = int(header["dimension"])
    for name in _PER_AXIS:
        if name in header and len(header[name]) != n:
            raise ValueError(f"{name}: {len(header[name])} entries for {n} axes")
    space_of(header)


def space_of(header: Mapping[str, Any]) -> str:
    """Return the space in full and in lower case, without its time; the empty text if there is none."""
    space = str(header.get("space", "")).lower()
    name = _SHORT.get(space.removesuffix("t"), space.removesuffix("-time"))
    if "space" in header and name not in _SPACES:
        raise ValueError(f"space: {space!r} is none of the format's, such as left-posterior-superior")
    return name


def check_data(file: Path, header: Mapping[str, Any], stream: BufferedReader, start: int) -> None:
    """Raise ValueError where compressed data do not end as they should, checksum included, or raw ones do not fit."""
    beside = header.get("data file", header.get("datafile"))
    encoding = str(header["encoding"]).lower()
    with ExitStack() as opened:
        source = stream if beside is None else opened.enter_context(open(file.parent / str(beside), "rb"))
        source.seek(start if beside is None else 0)
        for _ in range(int(header.get("line skip", header.get("lineskip", 0)))):
            source.readline()
        if encoding in _DECOMPRESSORS:
            _check_stream(source, _DECOMPRESSORS[encoding]())
        elif encoding == "raw" and not int(header.get("byte skip", header.get("byteskip", 0))):
            _check_length(source, header)


def _check_stream(source: BufferedReader, decompressor: Any) -> None:
    while not decompressor.eof:
        chunk = source.read(1 << 20)
        if not chunk:
            raise ValueError("the compressed data end early")
        decompressor.decompress(chunk)
    if (decompressor.unused_data + source.read()).strip(b"\0"):
        raise ValueError("something follows the compressed data")


def _check_length(source: BufferedReader, header: Mapping[str, Any]) -> None:
    start, count = source.tell(), math.prod(int(size) for size in header["sizes"])
    held = source.seek(0, os.SEEK_END) - start
    if count <= 0 or held % count:
        raise ValueError(f"{held} bytes of data for {count} values")
