"""Files and folders that appear whole or not at all."""

import os
import shutil
import uuid
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


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
        stale: returns the files that belong to what is replaced. They are removed before the new ones are moved, so
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
