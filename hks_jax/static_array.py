"""A NumPy array that is part of the problem's structure: hashable, immutable, known at trace time."""

import hashlib
from functools import cached_property
from typing import Any

import numpy as np


class StaticArray:
    """A read-only NumPy array compared and hashed by value, so that it can be static under `jax.jit`."""

    def __init__(self, value: Any, dtype: Any = None) -> None:
        array = np.array(value, dtype=dtype, order="C")
        array.setflags(write=False)
        self.value = array

    @cached_property
    def _digest(self) -> bytes:
        header = f"{self.value.dtype.str}{self.value.shape}".encode()
        return hashlib.blake2b(self.value.tobytes(), digest_size=16, key=header[:64]).digest()

    def __hash__(self) -> int:
        return hash(self._digest)

    def __eq__(self, other: object) -> bool:
        if self is other:
            return True
        return isinstance(other, StaticArray) and self._digest == other._digest

    def __repr__(self) -> str:
        return f"StaticArray({self.value.dtype}{list(self.value.shape)})"
