"""NumPy's archives, read without pickles."""

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
