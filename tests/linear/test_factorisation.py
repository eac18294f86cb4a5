"""The public factorisation against dense matrices: solves, determinants, inertia, inverses, and their derivatives."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse as sp
from annotations import unchecked
from differences import directional
from jax.experimental.sparse import BCOO
from pencils import directions, graph_laplacian, indefinite

import hks_jax as hj
from hks_jax.linear.dissection import dissect, merged
from hks_jax.linear.factorised_matrix import factorised
from hks_jax.linear.multifrontal import factorise


def masked_grid():
    rng = np.random.default_rng(3)
    mask = np.ones((11, 12), bool)
    mask[:4, 5:9] = False
    frames = np.eye(2) + 0.3 * rng.standard_normal((11, 12, 2, 2))
    field = hj.TensorField(hj.Grid((11, 12), 0.1, mask=mask), frames @ np.swapaxes(frames, 2, 3) + np.eye(2))
    return hj.assemble(field, boundary=("dirichlet", "neumann"))


def dense(domain, shift):
    if isinstance(domain, hj.Pencil):
        return np.asarray(domain.stiffness.to_dense() - shift * domain.mass.to_dense())
    K, M = domain if isinstance(domain, tuple) else (domain, sp.eye(domain.shape[0]))
    return (K - shift * M).toarray()


MATRICES = {
    "indefinite": (lambda: indefinite(120), 0.3),
    "components": (lambda: graph_laplacian(3, 40), 0.7),
    "grid": (masked_grid, 40.0),
    "1 × 1": (lambda: sp.csr_matrix([[-2.0]]), 0.0),
    "diagonal": (lambda: sp.diags([3.0, -1.0, 2.0]), 0.5),
}


@pytest.mark.parametrize(
    "name", [n if n in ("indefinite", "1 × 1") else pytest.param(n, marks=pytest.mark.slow) for n in MATRICES]
)
def test_all_results_against_the_dense_matrix(rng, name):
    make, shift = MATRICES[name]
    domain = make()
    matrix = dense(domain, shift)
    factor, values = hj.factorise(domain, shift), np.linalg.eigvalsh(matrix)
    assert factor.sound
    assert factor.error < 1e-8
    assert factor.inertia == (np.sum(values < 0), np.sum(values > 0))
    sign, logarithm = np.linalg.slogdet(matrix)
    assert factor.sign == sign
    np.testing.assert_allclose(factor.logdet(), logarithm, rtol=1e-11, atol=1e-10)
    inverse = np.diag(np.linalg.inv(matrix))
    np.testing.assert_allclose(factor.inverse_diagonal(), inverse, rtol=1e-9, atol=1e-10 * np.abs(inverse).max())
    block = rng.standard_normal((len(matrix), 3))
    for b in (block, block[:, 0]):
        x = np.asarray(factor.solve(b))
        backward = np.abs(matrix @ x - b).max() / (np.abs(matrix).sum(axis=1).max() * np.abs(x).max())
        assert backward < 1e-15


def by_factors(pencil, shift, b):
    factor = hj.factorise(pencil, shift)
    return factor.solve(b), factor.logdet(), factor.inverse_diagonal()


def by_dense(pencil, shift, b):
    matrix = pencil.stiffness.to_dense() - shift * pencil.mass.to_dense()
    inverse = jnp.linalg.inv(matrix)
    return inverse @ b, jnp.linalg.slogdet(matrix)[1], jnp.diag(inverse)


@pytest.mark.slow
def test_derivatives_by_entries_shift_and_right_hand_sides_of_first_and_second_order(rng):
    """In both modes, at an indefinite pencil, beside JAX's own of the dense matrix."""
    pencil = hj.sparse_pencil(*indefinite(70))
    b, w, d_b = rng.standard_normal((3, 70))
    of_k, of_m = directions(pencil, rng)
    at = pencil.stiffness.entries, pencil.mass.entries, jnp.asarray(0.3), jnp.asarray(b)
    change = of_k.stiffness.entries, of_m.mass.entries, jnp.asarray(0.2), jnp.asarray(d_b)

    def along(tree):
        return sum(map(jnp.vdot, tree, change))

    @partial(jax.jit, static_argnums=0)
    def derivatives(function, at):
        def value(at):
            moved = eqx.tree_at(lambda p: (p.stiffness.entries, p.mass.entries), pencil, at[:2])
            x, log_determinant, diagonal = function(moved, *at[2:])
            return jnp.vdot(w, x) + 3 * log_determinant + jnp.vdot(w, diagonal) ** 2

        def slope(at):
            return jax.jvp(value, (at,), (change,))[1]

        _, over_reverse = jax.jvp(jax.grad(value), (at,), (change,))
        first = slope(at), along(jax.grad(value)(at))
        return first, (jax.jvp(slope, (at,), (change,))[1], along(over_reverse), along(jax.grad(slope)(at)))

    for found, expected in zip(derivatives(by_factors, at), derivatives(by_dense, at), strict=True):
        np.testing.assert_allclose(found, np.full(len(found), expected[0]), rtol=1e-7)


@pytest.mark.slow
def test_gradient_by_the_tensors_of_a_grid_against_differences(rng):
    grid, tensors = hj.Grid((8, 9), 0.2), jnp.eye(2) + jnp.zeros((8, 9, 2, 2))
    change = rng.standard_normal((8, 9, 2, 2))
    change = jnp.asarray(change + np.swapaxes(change, 2, 3)) / 9

    @jax.jit
    def value(tensors):
        factor = hj.factorise(hj.TensorField(grid, tensors), -1.0)
        return factor.logdet() + jnp.sum(factor.inverse_diagonal()) / 50

    slope = jnp.vdot(jax.jit(jax.grad(value))(tensors), change)
    np.testing.assert_allclose(slope, directional(value, tensors, change), rtol=1e-8)


@pytest.mark.slow
def test_under_vmap_over_entries_and_shifts(rng):
    pencil = hj.sparse_pencil(graph_laplacian(2, 30))
    entries = pencil.stiffness.entries * jnp.asarray(rng.uniform(1, 1.1, (3, 1)))

    def results(entries, shift):
        factor = hj.factorise(eqx.tree_at(lambda p: p.stiffness.entries, pencil, entries), shift)
        return factor.solve(jnp.ones(pencil.size)), factor.logdet(), factor.inverse_diagonal(), factor.inertia

    shifts = jnp.array([0.31, 0.52, 2.43])
    together = jax.jit(jax.vmap(results))(entries, shifts)
    alone = jax.jit(results)
    for i in range(3):
        jax.tree.map(
            lambda x, y, i=i: np.testing.assert_allclose(x[i], y, rtol=1e-9), together, alone(entries[i], shifts[i])
        )


@pytest.mark.slow
def test_single_precision():
    K, M = (matrix.astype(np.float32) for matrix in indefinite(120))
    factor, matrix = hj.factorise((K, M), 0.3), dense((K, M), 0.3).astype(float)
    x = np.asarray(factor.solve(np.ones(120, np.float32)))
    assert x.dtype == np.float32
    assert np.abs(matrix @ x - 1).max() < 1e-6 * np.abs(matrix).sum(axis=1).max() * np.abs(x).max()
    np.testing.assert_allclose(factor.logdet(), np.linalg.slogdet(matrix)[1], rtol=1e-4)
    assert factor.inertia.negative == np.sum(np.linalg.eigvalsh(matrix) < 0)
    line = sp.diags([-1.0, 2.0, -1.0], [-1, 0, 1], shape=(120, 120), dtype=np.float32)
    values = 2 - 2 * np.cos(np.pi * np.arange(1, 121) / 121)  # of which one is next to the shift
    shift = float(np.float32(values[60] * (1 + 3e-6)))
    beside = hj.factorise(line, shift)
    with pytest.warns(hj.AccuracyWarning, match="rounding in float32 causes an error"):
        found = beside.logdet()
    assert abs(float(found) - np.log(np.abs(values - shift)).sum()) < 5 * float(beside.error)


def bipartite(n):
    """A regular matrix with eigenvalues ±s of which no pivot in any order on the diagonal is other than zero."""
    rng = np.random.default_rng(5)
    coupling = sp.random(n, n, 3 / n, random_state=rng) + sp.diags(rng.uniform(1, 2, n))
    return sp.bmat([[None, coupling], [coupling.T, None]]).tocsr()


@pytest.mark.slow
def test_blocks_that_are_singular_in_a_regular_matrix():
    """Pivots are replaced, solutions refined; the determinant, which cannot be, is refused."""
    matrix = bipartite(80)
    factor = hj.factorise(matrix)
    assert factor.inertia == (80, 80)
    np.testing.assert_allclose(matrix @ factor.solve(np.arange(160.0)), np.arange(160.0), atol=1e-11)
    assert np.isinf(factor.error)
    for result in (factor.logdet, factor.inverse_diagonal):
        with pytest.raises(ValueError, match="nonsingular A, but the elimination inverts a block"):
            result()
    places = jnp.asarray(np.stack(matrix.tocoo().coords, axis=1))
    traced = jax.jit(lambda values: hj.factorise(BCOO((values, places), shape=(160, 160))).logdet())
    assert np.isnan(traced(matrix.tocoo().data))


@pytest.mark.parametrize(
    ("copies", "told"), [(1, "3 null vector"), pytest.param(7, "at least 16 null vector", marks=pytest.mark.slow)]
)
def test_singular_matrices_are_errors_that_count_null_vectors(copies, told):
    with pytest.raises(ValueError, match=rf"got a singular matrix with {told}.*‖Av‖ ≤ \d\.\de-1\d"):
        hj.factorise(sp.block_diag([graph_laplacian(2, 12)] * copies))


@pytest.mark.parametrize("derivative", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_singular_matrices_have_results_that_are_nan_where_they_are_traced(derivative):
    pencil = hj.sparse_pencil(graph_laplacian(2, 12))

    def traced(entries):
        factor = hj.factorise(eqx.tree_at(lambda p: p.stiffness.entries, pencil, entries))
        x = factor.solve(jnp.ones(36))
        return jnp.sum(x), (factor.sound, factor.inertia, x, factor.logdet(), factor.sign)

    run = jax.jit(jax.value_and_grad(traced, has_aux=True) if derivative else lambda entries: (traced(entries), 0.0))
    (_, (sound, inertia, *others)), slope = run(pencil.stiffness.entries)
    assert not sound
    assert inertia == (-1, -1)
    assert all(np.isnan(other).all() for other in others)
    assert np.isnan(slope).all() == derivative


def test_bad_input():
    factor = hj.factorise(sp.eye(4))
    with unchecked():
        with pytest.raises(ValueError, match=r"b: got shape \(3,\); expected \(4,\) or \(4, m\)"):
            factor.solve(jnp.ones(3))
        with pytest.raises(ValueError, match="b: got complex numbers"):
            factor.solve(np.full(4, 1j))
        with pytest.raises(ValueError, match="shift: got nan"):
            hj.factorise(sp.eye(4), np.nan)
    with pytest.raises(ValueError, match="not symmetric"):
        hj.factorise(sp.csr_matrix([[1.0, 2.0], [0.0, 1.0]]))
    with pytest.raises(ValueError, match="several matrices"):
        hj.factorise(hj.TensorField(hj.Grid((4, 5), 1.0), np.broadcast_to(np.eye(2), (4, 5, 2, 2))), boundary="mirror")
    pencil = hj.sparse_pencil(sp.eye(4))
    with pytest.raises(ValueError, match="1 of 4 entries are NaN or infinite"):
        factorised(pencil.stiffness.with_flat(jnp.array([1.0, jnp.inf, 1.0, 1.0])))


@pytest.mark.slow
def test_where_solves_go_along_merged_levels():
    """As on accelerators, where the factors of the elimination tree are not kept."""
    plain = hj.factorise(graph_laplacian(3, 40), 0.7)
    tree = dissect(plain.matrix.pattern)
    along_merged = factorise(tree._replace(merged=merged(tree.levels, plain.size)), plain.matrix.flat())
    several = eqx.tree_at(lambda f: f.factor, plain, along_merged)
    for result in (lambda f: f.solve(jnp.ones(160)), lambda f: f.logdet(), lambda f: f.inverse_diagonal()):
        np.testing.assert_allclose(result(several), result(plain), rtol=1e-10)
