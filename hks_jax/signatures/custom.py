"""Signatures of your own: any function of the eigenvalues."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hks_jax.checks import require_real
from hks_jax.eigen.eigenpairs import Eigenpairs
from hks_jax.signatures.filters import Custom
from hks_jax.signatures.spectral import source_indices, spectral_columns, spectral_diagonal
from hks_jax.signatures.times import require_pairs


def spectral_signature(
    pairs: Eigenpairs, function: Callable[[Any, Array], Array], parameters: Any, sources: Any = None
) -> Float[Array, "m *shape"]:
    """Compute Σᵢ f(θ, λᵢ) φᵢ(x)², or with sources Σᵢ f(θ, λᵢ) φᵢ(x_s) φᵢ(x), for any f and each of m parameters θ.

    The heat kernel signature is ``spectral_signature(pairs, lambda t, x: jnp.exp(-t * x), times)``. Derivatives with
    respect to the tensors and to θ are exact at eigenvalues of any multiplicity.

    Args:
        pairs: from `eigenpairs`.
        function: maps (θ, λ) to f, elementwise in λ (any shape), differentiable by JAX on λ > 0. What is traced must
            come in by θ and not by closure. Every new function object compiles anew: define it once.
        parameters: θ, a pytree of floating point arrays with a leading axis m.
        sources: None for the diagonal; else node indices (n_sources, d), or (d,) for one; on a mesh vertex numbers.

    Returns:
        (m, *shape), or (m, n_sources, *shape) with sources; NaN outside the mask.

    Raises:
        ValueError: parameters without a common leading axis; bad sources.
    """
    dtype = require_pairs(pairs).eigenvalues.dtype
    require_real("parameters", parameters)
    parameters = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), parameters)
    shapes = [leaf.shape for leaf in jax.tree.leaves(parameters)]
    if not shapes or len({shape[:1] for shape in shapes}) != 1 or not all(shapes):
        raise ValueError(f"parameters: got leaves of shapes {shapes}; expected a common leading axis, one entry per f")
    filters = Custom(function, parameters)
    if sources is None:
        return spectral_diagonal(pairs, filters)
    return spectral_columns(pairs, filters, source_indices(pairs, sources))
