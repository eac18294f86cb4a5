"""Batches of matrices for LAPACK where several devices share one CPU."""

from collections.abc import Callable
from typing import TypeVar

import jax
from jaxtyping import Array

Output = TypeVar("Output")


def at_once_or_in_turn(function: Callable[[Array], Output], matrices: Array) -> Output:
    """Apply a function of LAPACK to a batch: at once, or among several devices of one CPU one matrix after another.

    Devices made out of one CPU share its pool of threads. With JAX 0.10, LAPACK's work on a batch is dealt out to that
    pool by a thread that waits there: as soon as as many devices wait as there are threads, they wait for ever.

    Args:
        function: of matrices (m, …) or one matrix, differentiable or not.
        matrices: (m, n, n).
    """
    if not jax.sharding.get_abstract_mesh().manual_axes:
        return function(matrices)
    return jax.lax.platform_dependent(matrices, cpu=lambda batch: jax.lax.map(function, batch), default=function)
