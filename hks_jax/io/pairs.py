"""Save and load eigenpairs, so that signatures at other times need no new eigenvalue computation."""

import os
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from hks_jax.eigen.doubled import DoubledEigenpairs
from hks_jax.eigen.eigenpairs import Eigenpairs, PencilEigenpairs
from hks_jax.fem.pencil import AnyPencil, MirrorPencil, Pencil
from hks_jax.storage import load_npz, write_npz

ARRAYS = (
    "vectors",
    *(f.name for f in fields(PencilEigenpairs) if f.name not in ("frame", "pencil", "solver_name", "spare")),
)
"""The attributes of `hks_jax.Eigenpairs` that are saved as arrays."""
_FAR = 1e-3
"""The residual, relative to the largest known eigenvalue, above which pairs count as pairs of another pencil."""


def save_pairs(path: str | os.PathLike[str], pairs: Eigenpairs, extra: Mapping[str, Any] | None = None) -> Path:
    """Write k eigenpairs for `load_pairs` to an uncompressed npz, which has about k numbers per degree of freedom.

    For a doubled domain, the file contains the eigenpairs of each problem. The pencil is not written. To assemble the
    pencil again, keep the tensors and the mask, or pass both as `extra`.

    Args:
        path: the file, ``.npz``, which is written atomically; missing folders are created.
        pairs: the result of `hks_jax.eigenpairs`, with concrete values.
        extra: more named arrays.

    Raises:
        ValueError: the suffix is not ``.npz``.

    Examples:
        >>> path = hj.io.save_pairs(folder / "pairs.npz", pairs)
        >>> np.array_equal(np.load(path)["eigenvalues"], pairs.eigenvalues)
        True
    """
    if not os.fspath(path).endswith(".npz"):
        raise ValueError(f"path: got {os.fspath(path)!r}; expected a name that ends in .npz")
    content: dict[str, Any] = {"eigenvalues": np.asarray(pairs.eigenvalues)}
    for prefix, each in zip(_prefixes(len(pairs.problems)), pairs.problems, strict=True):
        content |= {prefix + name: np.asarray(getattr(each, name)) for name in ARRAYS}
        content[f"{prefix}solver_name"] = each.solver_name
    content |= extra or {}
    write_npz(path, content, compressed=False)
    return Path(path)


def load_pairs(path: str | os.PathLike[str], pencil: AnyPencil) -> Eigenpairs:
    """Read eigenpairs that `save_pairs` wrote, for the same pencil.

    Signatures of the loaded eigenpairs equal signatures of the saved eigenpairs. Signatures of loaded eigenpairs have
    no derivatives with respect to the tensors, because the eigenproblem is not solved again.

    Args:
        path: the file.
        pencil: the result of `hks_jax.assemble` for the same field and boundary.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: `save_pairs` did not write the file, or the pairs have a wrong length or do not solve Kφ = λMφ.

    Examples:
        >>> path = hj.io.save_pairs(folder / "pairs.npz", pairs)
        >>> np.array_equal(hj.io.load_pairs(path, pairs.pencil).vectors, pairs.vectors)
        True
    """
    return pairs_of(os.fspath(path), load_npz(path), pencil)


def pairs_of(name: str, arrays: Mapping[str, np.ndarray], pencil: AnyPencil) -> Eigenpairs:
    """Return the eigenpairs in the arrays of the file `name`; see `load_pairs`."""
    parts = pencil.parts if isinstance(pencil, MirrorPencil) else (pencil,)
    problems = [
        _of_problem(name, arrays, prefix, part) for prefix, part in zip(_prefixes(len(parts)), parts, strict=True)
    ]
    pairs: Eigenpairs = problems[0]
    if isinstance(pencil, MirrorPencil):
        pairs = DoubledEigenpairs.of(problems, len(arrays["eigenvalues"]))
    gap = np.concatenate([_residuals(each) for each in pairs.problems])
    ends = np.array([pairs.next_eigenvalue, *pairs.eigenvalues[-1:], pairs.spectral_origin])
    size = np.max(np.abs(ends[np.isfinite(ends)]))
    worst = float(np.max(gap, initial=0)) / max(size, np.finfo(ends.dtype).tiny)
    if not worst < _FAR:
        raise ValueError(
            f"{name}: the pairs do not solve Kφ = λMφ for this pencil; got the relative residual {worst:.1e}, expected "
            f"at most {_FAR:g}. Use the tensors, mask, boundary and interpolation of the saved pairs"
        )
    return pairs


def _prefixes(problems: int) -> list[str]:
    """Return what the names of each problem's arrays begin with: nothing if there is one problem."""
    return [""] if problems == 1 else [f"problem_{number}_" for number in range(problems)]


def _of_problem(name: str, arrays: Mapping[str, np.ndarray], prefix: str, pencil: Pencil) -> PencilEigenpairs:
    """Return the pairs of one problem."""
    names = [key for key in ARRAYS if key != "rounding" or prefix + key in arrays]
    missing = [prefix + key for key in (*names, "solver_name") if prefix + key not in arrays]
    if missing:
        raise ValueError(
            f"{name}: the file lacks {', '.join(missing)}; expected a file that save_pairs wrote for the same boundary"
        )
    if not arrays.get("lowest", True):  # earlier versions wrote such files
        raise ValueError(f"{name}: got the eigenpairs of an interval; expected the lowest eigenpairs")
    dtype = pencil.stiffness.dtype
    values: dict[str, Any] = {
        key: jnp.asarray(a, dtype if a.dtype.kind == "f" else None) for key in names for a in [arrays[prefix + key]]
    }
    k, n = values["eigenvalues"].shape[-1], pencil.space.n_dof
    if values["vectors"].shape != (k, n):
        raise ValueError(
            f"{name}: got eigenfunctions of shape {values['vectors'].shape}; expected {(k, n)} for this pencil. Use "
            "the mask and the boundary with which the pairs were computed"
        )
    values.setdefault("rounding", jnp.zeros_like(values["eigenvalues"]))  # older files lack it
    solver = str(np.asarray(arrays[f"{prefix}solver_name"]))
    return PencilEigenpairs(frame=values.pop("vectors"), pencil=pencil, solver_name=solver, **values)


def _residuals(pairs: PencilEigenpairs) -> np.ndarray:
    """Return ‖Kφ − λMφ‖ / ‖Mφ‖ for the pairs."""
    image = pairs.pencil.mass.apply(pairs.frame)
    left = pairs.pencil.stiffness.apply(pairs.frame) - pairs.eigenvalues[:, None] * image
    return np.asarray(jnp.linalg.norm(left, axis=1) / jnp.linalg.norm(image, axis=1))
