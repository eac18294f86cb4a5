"""Patterns of sparse matrices: products, bisections of their graphs, and factorisations."""

from itertools import combinations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse as sp

import hks_jax as hj
from hks_jax.linear.bisection import bisect_graph, minimum_cover
from hks_jax.linear.dissection import dissect
from hks_jax.linear.multifrontal import factorise, try_out
from hks_jax.linear.operators import DiagonalOperator
from hks_jax.linear.symmetric_pencil import SymmetricPencil, tabulated


def random_graph(rng: np.random.Generator, n: int, edges: float) -> sp.csr_matrix:
    """A symmetric matrix with about so many entries in a row, and a full diagonal."""
    half = sp.random(n, n, edges / 2 / n, random_state=rng)
    return (half + half.T + sp.diags(rng.standard_normal(n))).tocsr()


def torus(n: int) -> sp.csr_matrix:
    """The Laplacian of a periodic lattice."""
    ring = sp.lil_matrix(2 * sp.eye(n) - sp.eye(n, k=1) - sp.eye(n, k=-1))
    ring[0, -1] = ring[-1, 0] = -1
    return (sp.kron(ring, sp.eye(n)) + sp.kron(sp.eye(n), ring)).tocsr()


def arrow(n: int) -> sp.csr_matrix:
    """A matrix with one full row."""
    matrix = sp.lil_matrix(sp.diags(np.arange(1.0, n + 1)))
    matrix[0, :] = matrix[:, 0] = 1
    return matrix.tocsr()


GRAPHS = {
    "random": lambda rng: random_graph(rng, 700, 3),
    "torus": lambda rng: torus(26) - 0.37 * sp.eye(676),
    "components": lambda rng: sp.block_diag([random_graph(rng, m, 2) for m in (1, 2, 60, 300, 5, 90)]).tocsr(),
    "no edges": lambda rng: sp.diags(rng.standard_normal(130)).tocsr(),
    "arrow": lambda rng: arrow(400),
    "full": lambda rng: sp.csr_matrix(np.cov(rng.standard_normal((60, 80)))),
}


@pytest.fixture(params=GRAPHS)
def matrix(request, rng):
    return GRAPHS[request.param](rng)


def test_separators_leave_no_edge_between_parts(matrix):
    pattern = hj.sparse_pencil(matrix).pattern
    level, part, depth = bisect_graph(pattern.size, pattern.rows, pattern.cols)
    assert level.min() >= 0
    assert level.max() < depth
    for first, second in zip(pattern.rows, pattern.cols, strict=True):
        # The one eliminated later separates a part that holds the other.
        low, high = sorted((first, second), key=lambda i: level[i])
        assert part[high] >> (level[high] - level[low]) == part[low]


def test_a_torus_is_halved_by_short_separators():
    pattern = hj.sparse_pencil(torus(60)).pattern
    level, part, _ = bisect_graph(pattern.size, pattern.rows, pattern.cols)
    assert np.sum(level == 0) <= 2 * 60 * 1.2  # the shortest are two rings
    halves = np.bincount(part[level > 0] >> (level[level > 0] - 1))
    assert halves.min() > 0.9 * halves.max()


def test_single_vertices_beside_a_graph_do_not_turn_its_cuts():
    path, short = (sp.diags([1.0, 1.0], [-1, 1], (n, n)) for n in (40, 20))
    lattice = sp.kron(path, sp.eye(20)) + sp.kron(sp.eye(40), short)
    pattern = hj.sparse_pencil(sp.block_diag([lattice, sp.eye(12)]).tocsr() + 9 * sp.eye(812)).pattern
    level, *_ = bisect_graph(pattern.size, pattern.rows, pattern.cols)
    assert np.sum(level == 0) <= 20 * 1.2


@pytest.mark.parametrize("name", [pytest.param("components", marks=pytest.mark.slow), "arrow"])
def test_products_with_a_few_long_rows(name, rng):
    matrix = GRAPHS[name](rng)
    operator = hj.sparse_pencil(matrix).stiffness
    x = rng.standard_normal((matrix.shape[0], 3))
    np.testing.assert_allclose(operator.of_columns()(jnp.asarray(x)), matrix @ x, atol=1e-12)
    np.testing.assert_allclose(operator.apply(jnp.asarray(x.T)), (matrix @ x).T, atol=1e-12)
    assert operator.structure.table.entries.size <= max(3 * matrix.nnz, matrix.shape[0])


def test_tables_of_a_pattern_are_arguments_of_what_is_compiled(matrix, rng):
    plain = hj.sparse_pencil(matrix)
    pencil, x = tabulated(plain), jnp.asarray(rng.standard_normal((matrix.shape[0], 3)))
    largest = []
    for each in (plain, pencil):
        traced = jax.make_jaxpr(lambda p, x: (p.stiffness.of_columns()(x), p.stiffness.diagonal()))(each, x)
        largest.append(max((np.size(constant) for constant in traced.consts), default=0))
    assert largest[0] >= matrix.shape[0] > 1 >= largest[1]
    np.testing.assert_allclose(pencil.stiffness.of_columns()(x), matrix @ x, atol=1e-12)
    np.testing.assert_array_equal(pencil.stiffness.diagonal(), matrix.diagonal())


@pytest.mark.parametrize("name", [n if n == "random" else pytest.param(n, marks=pytest.mark.slow) for n in GRAPHS])
def test_factorisation_of_any_pattern_solves_and_counts(name, rng):
    matrix = GRAPHS[name](rng)
    pencil = hj.sparse_pencil(matrix)
    factor = factorise(dissect(pencil.pattern), pencil.stiffness.flat())
    spectrum = np.linalg.eigvalsh(matrix.toarray())
    b = rng.standard_normal((matrix.shape[0], 2))
    assert try_out(factor, pencil, jnp.zeros(()), jnp.asarray(b)).sound
    assert factor.negative == np.sum(spectrum < 0)
    x = np.linalg.solve(matrix.toarray(), b)
    np.testing.assert_allclose(factor.solve(jnp.asarray(b)), x, atol=1e-7 * np.abs(x).max())


def test_a_cover_has_as_few_vertices_as_any(rng):
    for _ in range(40):
        edges = np.argwhere(rng.random((5, 6)) < 0.3)
        if not len(edges):
            continue
        here, there = edges[:, 0], edges[:, 1] + 5
        cover = set(minimum_cover(here, there))
        covers = [
            set(some)
            for size in range(len(cover) + 1)
            for some in combinations(range(11), size)
            if all(i in some or j in some for i, j in zip(here, there, strict=True))
        ]
        assert cover in covers
        assert len(cover) == min(map(len, covers))


def test_the_operator_is_a_pytree_with_its_pattern_as_structure():
    pencil = hj.sparse_pencil(torus(12))
    leaves, tree = jax.tree.flatten(pencil)
    assert [leaf.shape for leaf in leaves] == [(144 * 5,), (144,)]
    again = hj.sparse_pencil(torus(12))
    assert jax.tree.structure(again) == tree
    assert hash(jax.tree.structure(again)) == hash(tree)
    assert isinstance(pencil, SymmetricPencil)
    assert isinstance(pencil.mass, DiagonalOperator)
