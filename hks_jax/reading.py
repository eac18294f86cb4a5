"""Files that others wrote, or that came to harm: they exist, and what is wrong with them is said in one sentence."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


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
