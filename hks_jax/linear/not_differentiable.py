"""A guard for the rules of derivatives, where differentiating them once more would give wrong numbers."""

from functools import partial
from typing import NoReturn, TypeVar

import jax

Tree = TypeVar("Tree")


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def not_differentiable(message: str, tree: Tree) -> Tree:
    """Return ``tree`` unchanged; differentiating it raises NotImplementedError with this message."""
    return tree


@not_differentiable.defjvp
def _refuse(message: str, primals: tuple, tangents: tuple) -> NoReturn:
    raise NotImplementedError(message)
