"""Write and read eigenpairs with their tensors, for ``hks-jax hks --save-pairs`` and ``hks-jax hks PAIRS``."""

import json
import zipfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hks_jax import assemble
from hks_jax.cli.computation import Settings, Solved, domain_of_volume
from hks_jax.cli.progress import Progress
from hks_jax.io.arrays import place_of, volume_of
from hks_jax.io.json_files import plain, tuples
from hks_jax.io.pairs import pairs_of, save_pairs
from hks_jax.storage import load_npz

_RECORD = "field_record"
_ABOUT = ("order", "frame", "source", "digest", "notes", "repair")
"""The attributes of a volume that are saved as text."""


def arrays_in(path: Path) -> set[str]:
    """Return the names of the arrays in an npz; the empty set for other files."""
    if path.suffix.lower() != ".npz" or not zipfile.is_zipfile(path):
        return set()
    with zipfile.ZipFile(path) as archive:
        return {name.removesuffix(".npy") for name in archive.namelist()}


def is_saved_pairs(path: Path) -> bool:
    """Return whether a file contains eigenpairs with their tensors."""
    return _RECORD in arrays_in(path)


def write_pairs(path: Path, solved: Solved, warnings: Sequence[str], fingerprint: str = "") -> None:
    """Write eigenpairs with the volume, whose mask is the domain, and with the settings of their computation.

    The file also contains the suffix of image files (such as .nii.gz), the warnings, and the fingerprint of a subject.
    """
    volume = solved.domain.volume
    assert volume is not None
    record = {name: getattr(volume, name) for name in _ABOUT}
    record |= {"image": solved.domain.images[0], "warnings": warnings, "fingerprint": fingerprint}
    record["settings"] = solved.settings.of_pairs
    save_pairs(path, solved.pairs, {"tensors": volume.tensors, **place_of(volume), _RECORD: json.dumps(plain(record))})


def are_of(path: Path, fingerprint: str) -> bool:
    """Return whether a file contains eigenpairs with this fingerprint of input files and settings."""
    if not is_saved_pairs(path):
        return False
    with np.load(path) as arrays:  # reads only the array that is used
        return bool(json.loads(str(arrays[_RECORD]))["fingerprint"] == fingerprint)


def facts_of(path: Path) -> dict[str, Any]:
    """Return facts about saved eigenpairs: their number, the range of eigenvalues, and the settings."""
    arrays = load_npz(path)
    record, values = json.loads(str(arrays[_RECORD])), arrays["eigenvalues"]
    return {
        "eigenpairs": values.size,
        "eigenvalues": [float(values[0]), float(values[-1])],
        "shape": arrays["tensors"].shape[:-2],
        **{name: value for name, value in record["settings"].items() if value},
        "warnings": record["warnings"],
    }


def read_pairs(path: Path, settings: Settings, progress: Progress) -> Solved:
    """Return saved eigenpairs; settings in the file replace settings in `settings`."""
    arrays = load_npz(path)
    record: dict[str, Any] = json.loads(str(arrays[_RECORD]))
    about = {name: record[name] for name in _ABOUT if name in record} | {"notes": tuple(record["notes"])}
    volume = volume_of(str(path), arrays, arrays["tensors"], **about)
    boundary = tuples(record["settings"]["boundary"])
    settings = replace(settings, **{**record["settings"], "boundary": boundary})
    for warning in record["warnings"]:
        progress.warn(warning)
    with progress.stage("assembly"):
        domain = domain_of_volume(volume, settings, record["image"])
        pairs = pairs_of(str(path), arrays, assemble(domain.field, boundary))
    return Solved(domain, pairs, settings)
