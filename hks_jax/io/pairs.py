"""Eigenpairs in files, so that other times take no other computation."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from hks_jax.eigen.eigenpairs import Eigenpairs
from hks_jax.fem.pencil import AnyPencil
from hks_jax.storage import load_npz, write_npz

ARRAYS = (
    "eigenvalues",
    "vectors",
    "residuals",
    "converged",
    "kept",
    "lowest",
    "spectral_origin",
    "part",
    "next_eigenvalue",
    "complete_below",
    "multiplet_tolerance",
)
"""What of `hks_jax.Eigenpairs` is in a file; the matrices are assembled again."""
_FAR = 1e-3
"""The residual relative to the first eigenvalue beyond from which on pairs are those of another pencil."""


def save_pairs(path: str | os.PathLike[str], pairs: Eigenpairs, extra: Mapping[str, Any] | None = None) -> Path:
    """Write eigenpairs as an npz that `load_pairs` reads: k·(number of unknowns) numbers, not compressed.

    The matrices are not in it: keep the tensors and the mask, or give them as `extra`.

    Args:
        path: the file, ``.npz``; missing folders are made. It appears whole or not at all.
        pairs: from `hks_jax.eigenpairs`, with concrete values.
        extra: more arrays by name.

    Returns:
        The path.

    Raises:
        ValueError: another suffix.
    """
    if not os.fspath(path).endswith(".npz"):
        raise ValueError(f"path: got {os.fspath(path)!r}; expected a name that ends in .npz")
    arrays = {name: np.asarray(getattr(pairs, name)) for name in ARRAYS if getattr(pairs, name) is not None}
    content: dict[str, Any] = {**arrays, "solver_name": pairs.solver_name, **(extra or {})}
    write_npz(path, content, compressed=False)
    return Path(path)


def load_pairs(path: str | os.PathLike[str], pencil: AnyPencil) -> Eigenpairs:
    """Read eigenpairs that `save_pairs` wrote, for the pencil that they belong to.

    Signatures and all that is computed from the pairs are those of the pairs that were saved. Derivatives with respect
    to tensors run through the computation of the pairs, which is not repeated: there are none.

    Args:
        path: the file.
        pencil: from `hks_jax.assemble`, of the same field with the same boundary.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not such a file, or pairs of another pencil: of other unknowns, or that do not solve Kφ = λMφ.
    """
    return pairs_of(os.fspath(path), load_npz(path), pencil)


def pairs_of(name: str, arrays: Mapping[str, np.ndarray], pencil: AnyPencil) -> Eigenpairs:
    """Return the pairs that were read from a file; see `load_pairs`."""
    doubled = len(pencil.parts) > 1
    names = [key for key in ARRAYS if key != "part" or doubled]
    missing = [key for key in (*names, "solver_name") if key not in arrays]
    if missing:
        raise ValueError(f"{name}: lacks {', '.join(missing)}; expected eigenpairs as save_pairs writes them")
    dtype = pencil.parts[0].stiffness.dtype
    values: dict[str, Any] = {
        key: jnp.asarray(a, dtype if a.dtype.kind == "f" else None) for key in names for a in [arrays[key]]
    }
    k, n = values["eigenvalues"].shape[-1], pencil.space.n_dof
    if values["vectors"].shape != (k, n):
        raise ValueError(
            f"{name}: got eigenfunctions of shape {values['vectors'].shape}; expected {(k, n)}, those of this pencil. "
            "Are mask and boundary those that the pairs were computed with?"
        )
    lowest = bool(values.pop("lowest"))
    solver_name = str(np.asarray(arrays["solver_name"]))
    values.setdefault("part", None)
    pairs = Eigenpairs(**values, lowest=lowest, frame=values["vectors"], pencil=pencil, solver_name=solver_name)
    gap = np.concatenate([_residuals(pairs, number) for number in range(len(pencil.parts))])
    ends = np.array([pairs.next_eigenvalue, *pairs.eigenvalues[-1:], pairs.spectral_origin])
    size = np.max(np.abs(ends[np.isfinite(ends)]))
    worst = float(np.max(gap, initial=0)) / max(size, np.finfo(ends.dtype).tiny)
    if not worst < _FAR:
        raise ValueError(
            f"{name}: these pairs do not solve Kφ = λMφ for this pencil (relative residual {worst:.1e}); expected the "
            "tensors, the mask, the boundary and the interpolation that they were computed with"
        )
    return pairs


def _residuals(pairs: Eigenpairs, number: int) -> np.ndarray:
    """Return ‖Kφ − λMφ‖ / ‖Mφ‖ of the pairs of one part of a doubled domain."""
    part = pairs.pencil.parts[number]
    own = slice(None) if pairs.part is None else np.flatnonzero(np.asarray(pairs.part) == number)
    vectors = pairs.space.transfer(pairs.vectors[own], part.space)
    image = part.mass.apply(vectors)
    left = part.stiffness.apply(vectors) - pairs.eigenvalues[own][:, None] * image
    return np.asarray(jnp.linalg.norm(left, axis=1) / jnp.linalg.norm(image, axis=1))
