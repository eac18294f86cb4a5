"""Guards for the rules of derivatives, where differentiating them once more would give wrong numbers."""

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


_MESSAGE = (
    "second derivatives of eigenpairs and of their signatures with respect to the tensors, the vertices or the "
    "pencil are not implemented. First derivatives are, and their derivatives with respect to times and other "
    "parameters of the filter (in the other order, with jax.jvp for the inner one). For a Hessian use Gauss-Newton "
    "products, jax.vjp after jax.jvp of the signature, or central differences of jax.grad"
)


def first_order_only(tree: Tree) -> Tree:
    """Return ``tree`` unchanged; differentiating it raises NotImplementedError.

    The rules for eigenpairs and spectral functions hold at eigenpairs. Along a path their ingredients would have to
    rotate within multiple eigenvalues in a way that first derivatives do not know, so that differentiating the rules
    gives wrong numbers there. An error is better.
    """
    return not_differentiable(_MESSAGE, tree)
