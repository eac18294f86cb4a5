"""Files and folders that appear whole or not at all, and folders that one process at a time writes into."""

import os
import shutil
import uuid
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO


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


try:
    import fcntl
except ImportError:  # on Windows
    fcntl = None  # type: ignore[assignment]


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
