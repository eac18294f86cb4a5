"""Times for all subjects of a study, where none are given."""

import argparse
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from hks_jax.cli.arguments import LAST
from hks_jax.cli.info import describe
from hks_jax.io import TensorVolume


class Range(NamedTuple):
    """The times that suit one subject: those that its voxels and its eigenpairs resolve, and its size ends."""

    least: float
    largest: float


def suitable_range(volume: TensorVolume, args: argparse.Namespace) -> Range:
    """Return the range of times that suits a subject, from its metric and its size, before anything is computed.

    Raises:
        KeyError: the metric is the adjugate, or no tensor is valid.
    """
    suits: dict[str, Any] = describe(args.file, volume, args.boundary)["suits"]
    of = suits[args.metric or "tensor"]
    by_pairs = of["least_time_of_k"] * (1.0 if args.k is None else of["k"] / args.k) ** (2 / volume.dimension)
    return Range(max(of["least_time"], by_pairs), of["largest_time"])


def common_times(ranges: Mapping[str, Range], n: int, unit: str) -> tuple[float, ...]:
    """Return n times, log-spaced over what suits all subjects, rounded to three digits.

    Args:
        ranges: one for each subject, by name.
        n: how many.
        unit: ``"scanner"``: from the largest of the least times to the least of the largest; ``"lambda1"``: the same of
            λ₁t, whose largest is `LAST`.

    Raises:
        ValueError: no time suits all.
    """
    if unit == "lambda1":
        ranges = {name: Range(LAST * least / most, LAST) for name, (least, most) in ranges.items()}
    late, flat = max(ranges, key=lambda s: ranges[s].least), min(ranges, key=lambda s: ranges[s].largest)
    least, largest = ranges[late].least, ranges[flat].largest
    if least >= largest:
        raise ValueError(
            f"--times: none suits all subjects: {late} resolves only t ≥ {least:.3g}, and {flat} is flat from "
            f"t = {largest:.3g} on. Choose times, or more eigenpairs (-k); see what 'hks-jax info' says of {late}: "
            "tensors with eigenvalues near zero take its pairs (--repair nearest:1e-4)"
        )
    return tuple(float(f"{t:.3g}") for t in np.geomspace(least, largest, n)) if n > 1 else (float(f"{least:.3g}"),)
