"""Additional maps of the page: scalars and directions of the tensors, and regions."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Bool, Float, Int, Real

from hks_jax.signatures.regions import region_statistics


class Layer(NamedTuple):
    """A map that is shown beside the signature.

    Attributes:
        name: its heading.
        kind: ``"scalar"``, or ``"direction"`` for vectors without a sign.
        values: (n_nodes,), or (n_nodes, 3) for directions, at the nodes of the domain, in float32.
    """

    name: str
    kind: str
    values: Float[np.ndarray, "n_nodes *components"]


def tensor_layers(tensors: Real[ArrayLike, "*shape d d"], inside: Bool[np.ndarray, "*shape"]) -> list[Layer]:
    """Return mean eigenvalue, anisotropy and principal direction; raise ValueError unless tensors inside are finite.

    The length of the principal direction is the anisotropy.
    """
    array, d = np.asarray(tensors, np.float64)[inside], inside.ndim
    if not np.isfinite(array).all():
        raise ValueError("tensors: got NaN or infinite values in the domain; exclude their nodes by the mask")
    values, vectors = np.linalg.eigh((array + array.swapaxes(-1, -2)) / 2)
    mean = values.mean(axis=-1)
    spread = np.sqrt(np.sum(np.square(values - mean[:, None]), axis=-1))
    # Both are 0 for multiples of the identity, and 1 if only one eigenvalue is nonzero.
    size = np.abs(values.sum(axis=-1)) / np.sqrt(2) if d == 2 else np.sqrt(np.sum(values**2, axis=-1) / 1.5)
    anisotropy = spread / np.where(size > 0, size, 1)
    largest = np.argmax(np.abs(values), axis=-1)
    direction = np.zeros((len(array), 3))
    direction[:, :d] = anisotropy[:, None] * np.take_along_axis(vectors, largest[:, None, None], axis=2)[..., 0]
    return [
        Layer("Mean eigenvalue (diffusivity)", "scalar", mean.astype(np.float32)),
        Layer("Anisotropy (λ₁ − λ₂)/(λ₁ + λ₂)" if d == 2 else "Fractional anisotropy", "scalar", _single(anisotropy)),
        Layer("Principal direction", "direction", _single(direction)),
    ]


def scalar_layers(maps: Mapping[str, Any], inside: Bool[np.ndarray, "*shape"]) -> list[Layer]:
    """Return maps that are given by name; raise ValueError if a map has another shape."""
    for name, values in maps.items():
        if np.shape(values) != inside.shape:
            raise ValueError(f"maps[{name!r}]: got shape {np.shape(values)}; expected the grid's shape {inside.shape}")
    return [Layer(name, "scalar", _single(np.asarray(values)[inside])) for name, values in maps.items()]


def regions(
    labels: Real[ArrayLike, "*shape"], names: Mapping[int, str] | None, inside: Bool[np.ndarray, "*shape"]
) -> tuple[Int[np.ndarray, " n_nodes"], dict[int, str]]:
    """Return the labels inside, and the name or, without names, the number of each label that occurs.

    Raises:
        ValueError: if labels have another shape, are not integers, or are all 0.
    """
    found = region_statistics(np.where(inside, 1.0, np.nan)[None], labels)
    present = found.labels[found.nodes > 0].tolist()
    known = {label: f"label {label}" for label in present} | dict(names or {})
    return np.asarray(labels)[inside].astype("<i4"), {label: known[label] for label in present}


def _single(values: np.ndarray) -> np.ndarray:
    return np.asarray(values, dtype=np.float32)
