"""Where a result came from, so that a file can say it."""

import hashlib
import json
import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from hks_jax import __version__
from hks_jax.io.volume import TensorVolume


def digest(path: str | os.PathLike[str]) -> str:
    """Return the SHA-256 of a file's bytes, in hexadecimal."""
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def describe(volume: TensorVolume | None, more: Mapping[str, Any] | None) -> str:
    """Return one line of JSON: the version, the tensors' file and what was decided in reading it, and `more`."""
    record: dict[str, Any] = {"software": f"hks-jax {__version__}"}
    if volume is not None:
        record |= {"source": volume.source, "sha256": volume.digest, "order": volume.order, "frame": volume.frame}
        record |= {"notes": list(volume.notes)}
    return json.dumps({**record, **(more or {})}, default=_plain)  # in ASCII, which NRRD's header needs


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else str(value)
