"""Atomic writing of files, exclusive work by one process, errors for damaged files, and NumPy's file formats."""

import io
import math
import os
import shutil
import uuid
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy

try:
    import fcntl
except ImportError:  # on Windows
    fcntl = None  # type: ignore[assignment]

_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary name beside `path`, and atomically move the file with this name to `path` at the end.

    If the body raises, the temporary file is removed and `path` does not change. Missing parent folders are created.

    Examples:
        >>> with hj.io.atomic_path(folder / "hks.txt") as temporary:
        ...     _ = temporary.write_text("whole")
        >>> (folder / "hks.txt").read_text()
        'whole'
    """
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    # The suffix must be last, because libraries choose the format by it.
    temporary = target.with_name(f".{uuid.uuid4().hex[:12]}.{target.name}")
    try:
        yield temporary
        os.replace(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def atomic_folder(path: str | os.PathLike[str], stale: Callable[[], Iterable[Path]] = tuple) -> Iterator[Path]:
    """Yield a temporary folder beside `path`; move the files written there into `path` at the end.

    Files with the same names in `path` are replaced atomically, and others remain. If the body raises, its files are
    removed, and `path` does not change and is not created.

    Args:
        path: the folder.
        stale: a function that returns the files of an earlier result. They are removed before new files are moved, so
            that two results are never mixed.

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
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = target.with_name(f".{uuid.uuid4().hex[:12]}.{target.name}")
    done = False
    try:
        temporary.mkdir()
        yield temporary
        target.mkdir(exist_ok=True)
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


@contextmanager
def claim(path: str | os.PathLike[str]) -> Iterator[bool]:
    """Yield whether this process has exclusive access to a piece of work, by a lock on the file at `path`.

    At the end the file is removed, and its folder as well if it is empty. If the process dies, the operating system
    releases the lock and the file remains, which shows that the work was begun. Without such locks, as on Windows and
    some network drives, every process gets access.
    """
    file = Path(path)
    held = _hold(file)
    if held is None:
        yield False
        return
    with held:
        try:
            yield True
        finally:
            file.unlink(missing_ok=True)
            with suppress(OSError):  # the folder has other files
                file.parent.rmdir()


def _hold(file: Path) -> IO[str] | None:
    """Return the open and locked file, or None if another process has locked it."""
    while True:
        file.parent.mkdir(parents=True, exist_ok=True)
        # The file stays open after this function. Between any two of these steps another process may finish and remove
        # the file and its folder.
        with suppress(FileNotFoundError):
            held = open(file, "a", encoding="utf-8")  # noqa: SIM115
            try:
                if fcntl is not None:
                    fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                held.close()
                return None
            except OSError:  # a drive without locks
                pass
            with suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(held.fileno()), file.stat()):
                    return held
            held.close()


def existing(path: str | os.PathLike[str]) -> Path:
    """Return the path of a file; raise FileNotFoundError if it does not exist or is a folder."""
    file = Path(path)
    if not file.is_file():
        what = "is a folder; expected a file" if file.is_dir() else "no such file"
        raise FileNotFoundError(f"{file}: {what}")
    return file


@contextmanager
def reading(path: str | os.PathLike[str], kind: str) -> Iterator[None]:
    """Convert every error that a library raises for the content of a file to a ValueError that names the file.

    Libraries raise nearly any error for damaged files: errors of the parser, of struct, zlib and zipfile, of indices,
    or of memory for impossible sizes. The body should contain only the library's call and checks of its result. The
    kind of file has its article, as in ``"a readable npz archive"``.
    """
    try:
        yield
    except ImportError:
        raise
    except (Exception, SystemExit) as error:
        reason = " ".join(str(error).split())[:300] or type(error).__name__
        if isinstance(error, KeyError):
            reason = f"it lacks {reason}"
        raise ValueError(
            f"{os.fspath(path)}: the file is damaged or not {kind} ({reason}). Copy it again from an intact file"
        ) from error


def load_npz(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """Return all arrays of an npz archive by name, after their checksums are verified.

    A file that is no such archive, is damaged, or contains pickled objects raises ValueError.
    """
    file, arrays = existing(path), {}
    with reading(file, "a readable npz archive of plain arrays"), zipfile.ZipFile(file) as archive:
        _check_number(file, archive)
        for name in archive.namelist():
            content = archive.read(name)  # reading to the end verifies the checksum
            arrays[name.removesuffix(".npy")] = _array(io.BytesIO(content), len(content))
    return arrays


def write_npz(path: str | os.PathLike[str], content: Mapping[str, Any], compressed: bool = True) -> None:
    """Write arrays by name to an npz archive atomically."""
    save = np.savez_compressed if compressed else np.savez
    with atomic_path(path) as temporary, open(temporary, "wb") as stream:
        save(stream, **content)


def _check_number(file: Path, archive: zipfile.ZipFile) -> None:
    """Raise ValueError unless the archive's end states the number of listed members. A damaged list omits members."""
    with open(file, "rb") as stream:
        stream.seek(-(22 + len(archive.comment)), os.SEEK_END)
        end = stream.read()
    declared, listed = int.from_bytes(end[10:12], "little"), len(archive.filelist)
    if declared not in (listed, 0xFFFF):  # 0xFFFF means a larger number
        raise ValueError(f"its end states {declared} members, but it lists {listed}")


def load_npy(path: str | os.PathLike[str]) -> np.ndarray:
    """Return the array of an npy file, with errors as in `load_npz`.

    There is no checksum; only the file's length is compared with the declared length.
    """
    file = existing(path)
    with reading(file, "a readable npy array"), open(file, "rb") as stream:
        return _array(stream, file.stat().st_size)


def _array(stream: io.BytesIO | io.BufferedReader, length: int) -> np.ndarray:
    """Return the array in a stream. Its size is compared with the stream's before memory is allocated."""
    version = npy.read_magic(stream)
    if version not in _HEADERS:
        raise ValueError(f"format version {version}; expected one of {', '.join(map(str, _HEADERS))}")
    shape, _, dtype = _HEADERS[version](stream)
    if dtype.hasobject:
        raise ValueError("it contains pickled objects, which are not read because they could run programs")
    declared, held = math.prod(shape) * dtype.itemsize, length - stream.tell()
    if min(shape, default=0) < 0 or declared != held:
        raise ValueError(f"{dtype} of shape {shape} takes {declared} bytes, but the file has {held}")
    stream.seek(0)
    return npy.read_array(stream, allow_pickle=False).astype(dtype.newbyteorder("="), copy=False)
