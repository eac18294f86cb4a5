"""NumPy's own files, read whole and without pickles, and written whole."""

import io
import math
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy

from hks_jax.atomic import atomic_path
from hks_jax.reading import existing, reading

_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}


def load_npz(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """Return all arrays of an npz archive by name.

    The archive keeps a checksum of each array; all of them are compared.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not an npz archive, a damaged one, or one that holds pickled objects.
    """
    file, arrays = existing(path), {}
    with reading(file, "a readable npz archive of plain arrays"), zipfile.ZipFile(file) as archive:
        _check_number(file, archive)
        for name in archive.namelist():
            content = archive.read(name)  # to the end, which is where the checksum is compared
            arrays[name.removesuffix(".npy")] = _array(io.BytesIO(content), len(content))
    return arrays


def write_npz(path: str | os.PathLike[str], content: Mapping[str, Any], compressed: bool = True) -> None:
    """Write arrays by name, whole or not at all."""
    save = np.savez_compressed if compressed else np.savez
    with atomic_path(path) as temporary, open(temporary, "wb") as stream:
        save(stream, **content)


def _check_number(file: Path, archive: zipfile.ZipFile) -> None:
    """Raise ValueError unless the archive's end gives the number of its members, of which a damaged list hides some."""
    with open(file, "rb") as stream:
        stream.seek(-(22 + len(archive.comment)), os.SEEK_END)
        end = stream.read()
    declared, listed = int.from_bytes(end[10:12], "little"), len(archive.filelist)
    if declared not in (listed, 0xFFFF):  # the latter stands for more
        raise ValueError(f"it ends with {declared} members, and lists {listed}")


def load_npy(path: str | os.PathLike[str]) -> np.ndarray:
    """Return the array of an npy file, which has no checksum: only its length is compared with what it declares.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not an npy file, a damaged one, or one that holds pickled objects.
    """
    file = existing(path)
    with reading(file, "a readable npy array"), open(file, "rb") as stream:
        return _array(stream, file.stat().st_size)


def _array(stream: io.BytesIO | io.BufferedReader, length: int) -> np.ndarray:
    """Return the array that fills a stream; nothing is allocated before its size is compared with the stream's."""
    version = npy.read_magic(stream)
    if version not in _HEADERS:
        raise ValueError(f"format version {version}; expected one of {', '.join(map(str, _HEADERS))}")
    shape, _, dtype = _HEADERS[version](stream)
    if dtype.hasobject:
        raise ValueError("it holds pickled objects, which are not read, as they could run programs")
    declared, held = math.prod(shape) * dtype.itemsize, length - stream.tell()
    if min(shape, default=0) < 0 or declared != held:
        raise ValueError(f"{dtype} of shape {shape} takes {declared} bytes, but there are {held}")
    stream.seek(0)
    return npy.read_array(stream, allow_pickle=False).astype(dtype.newbyteorder("="), copy=False)
