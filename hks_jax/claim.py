"""Work that several processes share: each piece belongs to the process that claims it first."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

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
