"""Block Lanczos for the eigenvalues nearest to a shift."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hks_jax.eigen.multifrontal import Factorisation
from hks_jax.fem.pencil import Pencil


def block_lanczos(
    pencil: Pencil,
    factor: Factorisation,
    start: Float[Array, "b n_dof"],
    basis: Float[Array, "rows n_dof"],
    steps: int,
    wanted: int,
) -> tuple[Float[Array, " wanted"], Float[Array, "wanted n_dof"], Float[Array, "rows n_dof"]]:
    """Run Lanczos on (K − σM)⁻¹M, orthogonal to known eigenvectors.

    Neighbouring blocks are kept orthogonal by the recurrence, and two at a time by one pass against the whole basis,
    which reads it from memory half as often and leaves it M-orthonormal to rounding.

    Args:
        pencil: K and M.
        factor: the factorisation of K − σM.
        start: the first block, any vectors.
        basis: known M-orthonormal eigenvectors in its first rows, zero rows for all Lanczos vectors after them.
        steps: how many blocks; even.
        wanted: how many Ritz pairs to return.

    Returns:
        The Ritz values θ = 1/(λ − σ), largest magnitude first, M-orthonormal Ritz vectors, and the basis used up.
    """
    b = start.shape[0]
    w = basis.shape[0] - steps * b

    def project(x: Array, basis: Array) -> Array:
        return x - jnp.matmul(_products(basis, pencil.mass.apply(x)), basis, precision="highest")

    def apply(block: Array, before: Array, coupling: Array) -> tuple[Array, Array]:
        image = factor.solve(pencil.mass.apply(block))
        diagonal = _products(block, pencil.mass.apply(image))
        diagonal = (diagonal + diagonal.T) / 2
        image = image - jnp.matmul(diagonal, block, precision="highest")
        return diagonal, image - jnp.matmul(coupling.T, before, precision="highest")

    def step(j: int, state: tuple[Array, ...]) -> tuple[Array, ...]:
        basis, block, before, coupling, diagonals, couplings = state
        basis = jax.lax.dynamic_update_slice_in_dim(basis, block, w + 2 * j * b, axis=0)
        diagonal, rest = apply(block, before, coupling)
        middle, coupling = _orthonormal(pencil, rest)
        diagonal_2, rest = apply(middle, block, coupling)
        both = project(jnp.concatenate([middle, rest]), basis)
        middle, rest = both[:b], both[b:]
        rest = project(rest, middle)
        basis = jax.lax.dynamic_update_slice_in_dim(basis, middle, w + (2 * j + 1) * b, axis=0)
        following, coupling_2 = _orthonormal(pencil, rest)
        diagonals = diagonals.at[2 * j].set(diagonal).at[2 * j + 1].set(diagonal_2)
        couplings = couplings.at[2 * j].set(coupling).at[2 * j + 1].set(coupling_2)
        return basis, following, middle, coupling_2, diagonals, couplings

    block, _ = _orthonormal(pencil, project(start, basis))
    block, _ = _orthonormal(pencil, project(block, basis))
    blocks = jnp.zeros((steps, b, b), start.dtype)
    basis, _, _, _, diagonals, couplings = jax.lax.fori_loop(
        0, steps // 2, step, (basis, block, jnp.zeros_like(block), jnp.zeros_like(blocks[0]), blocks, blocks)
    )
    theta, modes = jnp.linalg.eigh(_projected(diagonals, couplings))
    order = jnp.argsort(-jnp.abs(theta))[:wanted]
    mix = jnp.pad(modes[:, order].T, ((0, 0), (w, 0)))
    return theta[order], jnp.matmul(mix, basis, precision="highest"), basis


def _orthonormal(pencil: Pencil, x: Float[Array, "b n_dof"]) -> tuple[Float[Array, "b n_dof"], Float[Array, "b b"]]:
    """Return M-orthonormal rows y and the factor R of x = Ry."""
    total = jnp.eye(x.shape[0], dtype=x.dtype)
    for _ in range(2):
        gram = _products(x, pencil.mass.apply(x))
        norms = jnp.sqrt(jnp.diagonal(gram))
        norms = jnp.where(norms > 0, norms, 1)
        sizes, mix = jnp.linalg.eigh(gram / norms / norms[:, None])
        sizes = jnp.sqrt(jnp.maximum(sizes, jnp.finfo(x.dtype).eps * sizes[-1]))
        x = jnp.matmul((mix / sizes / norms[:, None]).T, x, precision="highest")
        total = jnp.matmul(total, norms[:, None] * mix * sizes, precision="highest")
    return x, total


def _products(basis: Float[Array, "m n"], block: Float[Array, "b n"]) -> Float[Array, "b m"]:
    """Return the inner products.

    XLA's CPU kernels for a long contraction are many times faster with the large factor on the left, and for what
    comes after with the small one there and not transposed; the barriers keep XLA from turning either round.
    """
    products = jax.lax.optimization_barrier(jnp.matmul(basis, block.T, precision="highest"))
    return jax.lax.optimization_barrier(products.T)


def _projected(diagonal: Float[Array, "q b b"], couplings: Float[Array, "q b b"]) -> Float[Array, "m m"]:
    """Return the block tridiagonal matrix."""
    steps, b, _ = diagonal.shape
    matrix = jnp.zeros((steps, b, steps, b), diagonal.dtype)
    i, below = jnp.arange(steps), couplings[:-1]
    matrix = matrix.at[i, :, i, :].set(diagonal)
    matrix = matrix.at[i[:-1], :, i[1:], :].set(below)
    matrix = matrix.at[i[1:], :, i[:-1], :].set(jnp.swapaxes(below, 1, 2))
    return matrix.reshape(steps * b, steps * b)
