"""Sparse matrices that are none of ours, and ways to change them."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp


def graph_laplacian(components: int, n: int) -> sp.csr_matrix:
    """The Laplacian of random graphs, n vertices each, and a star of which the hub has n − 1 neighbours."""
    blocks = []
    for seed in range(components):
        hits = sp.random(n, n, 5 / n, random_state=seed) + sp.eye(n, k=1)
        graph = ((hits + hits.T) > 0).astype(float)
        graph.setdiag(0)
        blocks.append(sp.diags(np.asarray(graph.sum(axis=1)).ravel()) - graph)
    star = sp.lil_matrix((n, n))
    star[0, 1:] = star[1:, 0] = -1
    star.setdiag([n - 1] + [1] * (n - 1))
    return sp.block_diag([*blocks, star]).tocsr()


def indefinite(n: int) -> tuple[sp.csr_matrix, sp.csr_matrix]:
    """A random indefinite K, and a positive definite M with another pattern."""
    rng = np.random.default_rng(7)
    K = sp.random(n, n, 2.5 / n, random_state=0)
    L = sp.random(n, n, 1 / n, random_state=1)
    return ((K + K.T) / 2 + sp.diags(rng.standard_normal(n))).tocsr(), (
        L @ L.T + sp.diags(rng.uniform(1, 2, n))
    ).tocsr()


def directions(pencil, rng):
    """Symmetric changes of the entries of K and M."""
    n, pattern = pencil.size, pencil.pattern
    at = sp.coo_matrix((rng.standard_normal(pattern.rows.size), (pattern.rows, pattern.cols)), shape=(n, n)).tocsr()
    change = np.asarray(((at + at.T) / 2)[pattern.rows, pattern.cols]).ravel()
    for name in ("stiffness", "mass"):
        yield eqx.tree_at(
            lambda p, name=name: getattr(p, name).entries, jax.tree.map(jnp.zeros_like, pencil), jnp.asarray(change)
        )


def lattice(n: int) -> sp.csr_matrix:
    """The Laplacian of a torus of n × n vertices, whose eigenvalues come in groups of four."""
    ring = sp.lil_matrix(2 * sp.eye(n) - sp.eye(n, k=1) - sp.eye(n, k=-1))
    ring[0, -1] = ring[-1, 0] = -1
    return (sp.kron(ring, sp.eye(n)) + sp.kron(sp.eye(n), ring)).tocsr()
