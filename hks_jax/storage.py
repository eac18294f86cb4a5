"""Files written whole or not at all, one process at a time; files that came to harm, read; and NumPy's own files."""

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
    """Yield a temporary name beside `path`; move what was written there to `path` at the end, in one step.

    If the body raises, whatever it wrote is removed and `path` stays as it was. Missing parent folders are made.
    """
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    # The suffix stays last: libraries choose the format by it.
    temporary = target.with_name(f".{uuid.uuid4().hex[:12]}.{target.name}")
    try:
        yield temporary
        os.replace(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def atomic_folder(path: str | os.PathLike[str], stale: Callable[[], Iterable[Path]] = tuple) -> Iterator[Path]:
    """Yield a temporary folder beside `path`; move the files written there into `path` at the end.

    Files of the same names in `path` are replaced, each in one step; others stay. If the body raises, everything it
    wrote is removed and `path` stays as it was, or does not come into being.

    Args:
        path: the folder.
        stale: returns the files that belong to the replaced ones. They are removed before the new ones are moved, so
            that never two results are mixed.

    Raises:
        NotADirectoryError: `path` is a file.
    """
    target = Path(path)
    if target.exists() and not target.is_dir():
        raise NotADirectoryError(f"{target}: is a file; expected a folder, or a name that is free")
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
    """Yield whether a piece of work is this process's alone: no other process holds the file at `path` meanwhile.

    At the end the file is removed, and its folder if that is empty. If the process dies, the operating system gives the
    file free, and the file stays: it tells that the work was begun. Where there are no such locks, as on Windows and on
    some network drives, all work counts as this process's.
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
            with suppress(OSError):  # it has other files
                file.parent.rmdir()


def _hold(file: Path) -> IO[str] | None:
    """Return the open file, locked, or None where another process has it."""
    while True:
        file.parent.mkdir(parents=True, exist_ok=True)
        # The file is held beyond this function. Between any two of these steps another process may finish, and remove
        # the file and its folder.
        with suppress(FileNotFoundError):
            held = open(file, "a", encoding="utf-8")  # noqa: SIM115
            if not _lock(held):
                held.close()
                return None
            with suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(held.fileno()), file.stat()):
                    return held
            held.close()


def _lock(held: IO[str]) -> bool:
    if fcntl is None:
        return True
    try:
        fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a drive without locks
        return True
    return True


def existing(path: str | os.PathLike[str]) -> Path:
    """Return the path of a file that exists.

    Raises:
        FileNotFoundError: it does not, or is a folder.
    """
    file = Path(path)
    if not file.is_file():
        what = "is a folder; expected a file" if file.is_dir() else "no such file"
        raise FileNotFoundError(f"{file}: {what}")
    return file


@contextmanager
def reading(path: str | os.PathLike[str], kind: str) -> Iterator[None]:
    """Make one ValueError, which names the file, of whatever a library raises over its content.

    Libraries raise nearly anything over damaged files: errors of the parser, of struct, zlib and zipfile, of
    indices, of memory for sizes that no file has. Inside should be nothing but the library's call and checks of what
    it returned.

    Args:
        path: the file.
        kind: what it should be, with its article, such as ``"a readable npz archive"``.
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
            f"{os.fspath(path)}: not {kind}, or a damaged one ({reason}). Copy the file again from where it was whole"
        ) from error


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
