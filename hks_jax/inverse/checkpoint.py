"""Checkpoints of a fit. A checkpoint file is written completely or not at all."""

import dataclasses
import hashlib
import os
import re
from typing import Any

import jax
import numpy as np

from hks_jax.inverse.metric_fit import Step
from hks_jax.storage import load_npz, write_npz


@dataclasses.dataclass
class Checkpoint:
    """The state of a fit between steps."""

    values: Any  # the unknowns
    history: list[Step]  # the steps so far
    start: int  # the index of the current initial guess; 0 is the initial field
    stage: int  # the index of the current continuation stage; later stages fit smaller times
    step_size: float  # the divisor of the Gauss–Newton damping
    best: Any  # the unknowns of the best fit from an earlier initial guess
    losses: list[float]  # the final loss for each earlier initial guess
    ended: str = "interrupted"  # how the best fit ended


def fingerprint(*parts: Any) -> str:
    """Return a hash of arrays, grids, settings and names of functions, which is the same in every process."""
    structure = re.sub(r" at 0x\w+", "", str(jax.tree.structure(parts)))  # without the addresses of functions
    digest = hashlib.blake2b(structure.encode(), digest_size=16)
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
        raise ValueError(f"checkpoint: {error}. Use another name, or remove the file") from error
    lacking = {"mark", *(field.name for field in dataclasses.fields(Checkpoint))} - set(data)
    if lacking:
        names = ", ".join(sorted(lacking))
        raise ValueError(f"checkpoint: got {path} without {names}; expected a fit's checkpoint. Use another file")
    if str(data["mark"]) != mark:
        raise ValueError(
            f"checkpoint: {path} belongs to another fit (another target, initial field or setting). Use another name, "
            "or remove it"
        )
    history = [Step(*row) for row in data["history"].tolist()]
    start, stage, step_size = (data[name].item() for name in ("start", "stage", "step_size"))
    losses, ended = data["losses"].tolist(), str(data["ended"])
    return Checkpoint(data["values"], history, start, stage, step_size, data["best"], losses, ended)
