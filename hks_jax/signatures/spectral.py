"""Spectral functions: the diagonal, columns and trace of Φ f(Λ) Φᵀ, on which every signature stands."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from hks_jax.eigen.eigenpairs import Eigenpairs


def spectral_diagonal(pairs: Eigenpairs, filters: Float[Array, "m k"]) -> Float[Array, "m *shape"]:
    """Return Σᵢ f(λᵢ) φᵢ(x)² for each row f(λ) of ``filters``; NaN outside the mask."""
    return pairs.space.extend(jnp.matmul(filters, jnp.square(pairs.vectors), precision="highest"))


def spectral_columns(
    pairs: Eigenpairs, filters: Float[Array, "m k"], sources: Int[np.ndarray, " s"]
) -> Float[Array, "m s *shape"]:
    """Return Σᵢ f(λᵢ) φᵢ(x_s) φᵢ(x) for each filter and each source node (flat node index); NaN outside the mask."""
    weighted = filters[:, None, :] * at_nodes(pairs, sources).T[None, :, :]
    return pairs.space.extend(jnp.matmul(weighted, pairs.vectors, precision="highest"))


def at_nodes(pairs: Eigenpairs, sources: Int[np.ndarray, " s"]) -> Float[Array, "k s"]:
    """Return the eigenfunctions' values at the source nodes."""
    nodal = pairs.space.extend(pairs.vectors)
    return nodal.reshape(nodal.shape[0], pairs.space.free.size)[:, sources]


def source_indices(pairs: Eigenpairs, sources: object) -> Int[np.ndarray, " s"]:
    """Return flat node indices of sources given as grid indices (s, d) or (d,), or vertex numbers (s,) or one.

    Raises:
        ValueError: wrong shape or type, out of range, or outside the mask.
    """
    shape = pairs.space.node_shape
    array = np.asarray(sources)
    if not np.issubdtype(array.dtype, np.integer):
        raise ValueError(f"sources: got dtype {array.dtype}; expected integer node indices")
    indices = array.reshape(-1, len(shape)) if array.size % len(shape) == 0 else array
    expected = "(s,) vertex numbers" if len(shape) == 1 else f"(s, {len(shape)}) node indices"
    if indices.shape[-1:] != (len(shape),) or (len(shape) > 1 and array.shape[-1:] != (len(shape),)):
        raise ValueError(f"sources: got shape {array.shape}; expected {expected}")
    if (indices < 0).any() or (indices >= shape).any():
        raise ValueError(f"sources: got indices {indices.min()} … {indices.max()}; expected nodes of shape {shape}")
    flat = np.ravel_multi_index(tuple(indices.T), shape)
    outside = ~pairs.space.domain.ravel()[flat]
    if outside.any():
        raise ValueError(
            f"sources: {int(outside.sum())} of {flat.size} are outside the mask (the first is "
            f"{tuple(indices[outside][0].tolist())}); choose nodes of the domain"
        )
    return flat
