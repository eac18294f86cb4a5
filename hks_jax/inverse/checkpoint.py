"""Checkpoints of a fit, which appear whole or not at all."""

import dataclasses
import hashlib
import os
from typing import Any

import jax
import numpy as np

from hks_jax.inverse.metric_fit import Step
from hks_jax.storage import load_npz, write_npz


@dataclasses.dataclass
class Checkpoint:
    """Where a fit stands."""

    values: Any  # the unknowns
    history: list[Step]  # the steps so far
    start: int  # which of the starts
    stage: int  # which stage of the continuation
    step_size: float  # by which the damping is divided
    best: Any  # the unknowns of the best of the starts before
    losses: list[float]  # of the starts before


def fingerprint(*parts: Any) -> str:
    """Return a hash of arrays and settings. A function counts by its name, which another process gives it too."""
    digest = hashlib.blake2b(digest_size=16)
    for leaf in jax.tree.leaves(parts):
        text = getattr(leaf, "__qualname__", repr(leaf)).encode()
        digest.update(np.asarray(leaf).tobytes() if hasattr(leaf, "dtype") else text)
    return digest.hexdigest()


def save(path: str | os.PathLike[str], mark: str, checkpoint: Checkpoint) -> None:
    """Write a checkpoint."""
    columns = np.dtype([(field.name, field.type) for field in dataclasses.fields(Step)])
    rows = np.array([dataclasses.astuple(step) for step in checkpoint.history], columns)
    content = vars(checkpoint) | {"mark": mark, "history": rows, "losses": np.array(checkpoint.losses)}
    write_npz(path, content, compressed=False)


def load(path: str | os.PathLike[str], mark: str) -> Checkpoint:
    """Read a checkpoint."""
    try:
        data = load_npz(path)
    except (OSError, ValueError) as error:
        raise ValueError(f"checkpoint: {error}; or give another name, or remove it") from error
    lacking = {"mark", *(field.name for field in dataclasses.fields(Checkpoint))} - set(data)
    if lacking:
        names = ", ".join(sorted(lacking))
        raise ValueError(f"checkpoint: {path} is not one of a fit, it lacks {names}; give another name, or remove it")
    if str(data["mark"]) != mark:
        raise ValueError(
            f"checkpoint: {path} is of another fit (another target, initial field or setting); give another name, "
            "or remove it"
        )
    history = [Step(*row) for row in data["history"].tolist()]
    start, stage, step_size = (data[name].item() for name in ("start", "stage", "step_size"))
    return Checkpoint(data["values"], history, start, stage, step_size, data["best"], data["losses"].tolist())
