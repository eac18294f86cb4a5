"""Atomic writing of files, errors for damaged files, and NumPy's file formats."""

import gzip
import io
import math
import os
import shutil
import uuid
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy

_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield the path of a temporary file beside `path`; at the end, move this file atomically to `path`.

    If the body raises, the temporary file is removed and `path` does not change. Missing parent folders are created.

    Examples:
        >>> with hj.io.atomic_path(folder / "hks.txt") as temporary:
        ...     _ = temporary.write_text("whole")
        >>> (folder / "hks.txt").read_text()
        'whole'
    """
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    # Libraries choose the format by the suffix, so the temporary name must end with it.
    temporary = target.with_name(f".{uuid.uuid4().hex[:12]}.{target.name}")
    try:
        yield temporary
        os.replace(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def atomic_folder(path: str | os.PathLike[str], stale: Callable[[], Iterable[Path]] = tuple) -> Iterator[Path]:
    """Yield a temporary folder in `path`; move the files written there into `path` at the end.

    Each moved file atomically replaces a file of the same name in `path`; other files remain. If the body raises, the
    temporary folder is removed, and so is `path` if it did not exist before.

    Args:
        path: the folder.
        stale: a function that returns the files of an earlier result. These earlier files are removed before the new
            files are moved, so that `path` never contains files of two results.

    Raises:
        NotADirectoryError: if `path` is a file.

    Examples:
        >>> with hj.io.atomic_folder(folder / "results") as temporary:
        ...     _ = (temporary / "hks.txt").write_text("whole")
        >>> (folder / "results" / "hks.txt").read_text()
        'whole'
    """
    target = Path(path)
    if target.exists() and not target.is_dir():
        raise NotADirectoryError(f"{target}: got a file; expected a folder or an unused name")
    absent = [folder for folder in (target, *target.parents) if not folder.exists()]
    # The temporary folder is in the target, because the target's parent may be on another drive or not writable.
    temporary = target / f".{uuid.uuid4().hex[:12]}.unfinished"
    done = False
    try:
        temporary.mkdir(parents=True)
        yield temporary
        for file in stale():
            file.unlink(missing_ok=True)
        for file in sorted(temporary.iterdir()):
            os.replace(file, target / file.name)
        done = True
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
        if not done:
            for folder in absent:  # innermost first
                with suppress(OSError):
                    folder.rmdir()


def content_of(path: Path) -> bytes:
    """Return the bytes of a file, decompressed if they begin with gzip's magic number, whatever the file's name."""
    content = path.read_bytes()
    return gzip.decompress(content) if content.startswith(b"\x1f\x8b") else content


def existing(path: str | os.PathLike[str]) -> Path:
    """Return the path of a file; raise FileNotFoundError if it does not exist or is a folder."""
    file = Path(path)
    if not file.is_file():
        what = "is a folder; expected a file" if file.is_dir() else "no such file"
        raise FileNotFoundError(f"{file}: {what}")
    return file


class UnsuitedError(Exception):
    """The error within `reading` for a file that is not damaged, but has other content than expected."""


@contextmanager
def reading(path: str | os.PathLike[str], kind: str) -> Iterator[Path]:
    """Yield the path of an existing file, and convert every error of the body to a ValueError that names the file.

    For damaged files, libraries raise nearly any error, such as IndexError, zlib.error, or MemoryError for impossible
    sizes. The body should contain only the library's call and checks of its result. ``kind`` is the kind of file with
    its article, as in ``"a readable npz archive"``. The message says that the file is damaged, except for an
    `UnsuitedError`.
    """
    file = existing(path)
    try:
        yield file
    except ImportError:
        raise
    except UnsuitedError as error:
        raise ValueError(f"{file}: {error}") from error
    except (Exception, SystemExit) as error:
        reason = " ".join(str(error).split())[:300] or type(error).__name__
        if isinstance(error, KeyError):
            reason = f"it lacks {reason}"
        raise ValueError(
            f"{file}: the file is damaged or not {kind} ({reason}). Copy it again from an intact file"
        ) from error


def load_npz(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """Return all arrays of an npz archive by name, after their checksums are verified.

    Raises ValueError if the file is damaged, is not such an archive, or contains pickled objects.
    """
    arrays = {}
    with reading(path, "a readable npz archive of plain arrays") as file, zipfile.ZipFile(file) as archive:
        _check_number(file, archive)
        for name in archive.namelist():
            content = archive.read(name)  # reading to the end verifies the checksum
            arrays[name.removesuffix(".npy")] = _array(io.BytesIO(content), len(content))
    return arrays


def write_npz(path: str | os.PathLike[str], content: Mapping[str, Any], compressed: bool = True) -> None:
    """Write arrays by name to an npz archive atomically."""
    arrays: dict[str, Any] = {name: np.asarray(array) for name, array in content.items()}
    if objects := [name for name, array in arrays.items() if array.dtype.hasobject]:
        raise ValueError(f"{', '.join(objects)}: got Python objects for an npz; expected arrays of numbers or texts")
    save = np.savez_compressed if compressed else np.savez
    with atomic_path(path) as temporary, open(temporary, "wb") as stream:
        save(stream, **arrays)


def _check_number(file: Path, archive: zipfile.ZipFile) -> None:
    """Raise ValueError unless the archive lists as many members as its end record states."""
    with open(file, "rb") as stream:
        stream.seek(-(22 + len(archive.comment)), os.SEEK_END)
        end = stream.read()
    declared, listed = int.from_bytes(end[10:12], "little"), len(archive.filelist)
    if declared not in (listed, 0xFFFF):  # 0xFFFF means a larger number
        raise ValueError(f"its end record states {declared} members, but its list has {listed}")


def load_npy(path: str | os.PathLike[str]) -> np.ndarray:
    """Return the array of an npy file; raise errors as `load_npz` does.

    The format has no checksum; only the file's length is compared with the declared length.
    """
    with reading(path, "a readable npy array") as file, open(file, "rb") as stream:
        return _array(stream, file.stat().st_size)


def _array(stream: io.BytesIO | io.BufferedReader, length: int) -> np.ndarray:
    """Return the array in a stream; raise ValueError if its declared size does not match the stream's length."""
    version = npy.read_magic(stream)
    if version not in _HEADERS:
        raise ValueError(f"got format version {version}; expected one of {', '.join(map(str, _HEADERS))}")
    shape, _, dtype = _HEADERS[version](stream)
    if dtype.hasobject:
        raise ValueError("it contains pickled objects, which are not read because they could run programs")
    declared, held = math.prod(shape) * dtype.itemsize, length - stream.tell()
    if min(shape, default=0) < 0 or declared != held:
        raise ValueError(f"an array {dtype} of shape {shape} has {declared} bytes, but the file has {held}")
    stream.seek(0)
    return npy.read_array(stream, allow_pickle=False).astype(dtype.newbyteorder("="), copy=False)
