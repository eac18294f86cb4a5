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


def describe_tensors(volume: TensorVolume, order: str, frame: str, more: Mapping[str, Any] | None) -> str:
    """Return the same of tensors that are written: their order, frame, axes and units are those in the new file.

    What the file had that they came from is ``source_order`` and ``source_frame``.
    """
    stored = {"order": order, "frame": frame, "source_order": volume.order, "source_frame": volume.frame}
    stored |= {"axes": volume.volume_affine[:3, :3].tolist(), "length_unit": volume.length_unit, "unit": volume.unit}
    return describe(volume, {**stored, **(more or {})})


def own_record(text: str | bytes) -> dict[str, Any]:
    """Return what `describe_tensors` wrote; empty where the text is anything else."""
    try:
        record = json.loads(text.rstrip(b"\0") if isinstance(text, bytes) else text)
    except ValueError:
        return {}
    ours = isinstance(record, dict) and str(record.get("software", "")).startswith("hks-jax ")
    return record if ours and "source_frame" in record else {}


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else str(value)
