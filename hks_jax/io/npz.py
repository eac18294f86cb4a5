"""NumPy's own files, read without pickles."""

import os
import zipfile
from typing import Any

import numpy as np

from hks_jax.io.nifti import existing


def load_npz(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Return all arrays of an npz archive by name.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not an npz archive, or one that holds pickled objects.
    """
    file = existing(path)
    try:
        with np.load(file, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except (OSError, EOFError, ValueError, AttributeError, TypeError, zipfile.BadZipFile) as error:
        raise ValueError(f"{file}: not a readable npz archive of plain arrays ({error})") from error


def load_npy(path: str | os.PathLike[str]) -> np.ndarray:
    """Return the array of an npy file.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not an npy file, or one that holds pickled objects.
    """
    file = existing(path)
    try:
        return np.load(file, allow_pickle=False)
    except (OSError, EOFError, ValueError) as error:
        raise ValueError(f"{file}: not a readable npy array ({error})") from error
