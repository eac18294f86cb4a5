"""The solver of lineax: what lineax's own tests ask of a solver, for symmetric and Hermitian operators."""

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest
import scipy.sparse as sp
from pencils import indefinite

import hks_jax as hj

SOLVER = hj.Multifrontal()
N = 4


def matrix_of(kind, rng, n=N):
    """A symmetric indefinite, a positive definite Hermitian, a complex symmetric, a tridiagonal matrix."""
    a = rng.standard_normal((n, n)) + (1j * rng.standard_normal((n, n)) if kind in ("hermitian", "complex") else 0)
    if kind == "hermitian":
        return a @ a.conj().T + np.eye(n)
    a = a + a.T + np.diag(3 * (-1.0) ** np.arange(n))
    return np.triu(np.tril(a, 1), -1) if kind == "tridiagonal" else a


def operators(kind, matrix):
    tag = lx.positive_semidefinite_tag if kind == "hermitian" else lx.symmetric_tag
    matrix = jnp.asarray(matrix)
    yield lx.MatrixLinearOperator(matrix, tag)
    like = jax.ShapeDtypeStruct((len(matrix),), matrix.dtype)
    yield lx.FunctionLinearOperator(lambda x: matrix @ x, like, tag)
    if kind == "tridiagonal":
        bands = (jnp.diagonal(matrix, k) for k in (0, -1, 1))
        yield lx.TaggedLinearOperator(lx.TridiagonalLinearOperator(*bands), tag)
    if kind in ("real", "tridiagonal"):
        half = hj.SparseLinearOperator(matrix / 2)
        negative = -lx.TaggedLinearOperator(half, tag)
        yield (half * 6 + negative * 4 - lx.MatrixLinearOperator(matrix, tag)) / 2 + half * 2


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["real", "tridiagonal", "hermitian", "complex"])
def test_solutions_transposes_and_conjugates(rng, kind):
    matrix = matrix_of(kind, rng)
    b = jnp.asarray(matrix @ rng.standard_normal(N))
    for operator in operators(kind, matrix):
        np.testing.assert_allclose(operator.as_matrix(), matrix, atol=1e-13)

        def solve(b, operator=operator):
            return lx.linear_solve(operator, b, SOLVER).value

        np.testing.assert_allclose(solve(b), np.linalg.solve(matrix, b), atol=1e-10)
        (transposed,) = jax.linear_transpose(solve, b)(b)
        np.testing.assert_allclose(transposed, np.linalg.solve(matrix.T, b), atol=1e-10)
    state, options = SOLVER.conj(SOLVER.init(operator, {}), {})
    np.testing.assert_allclose(SOLVER.compute(state, b, options)[0], np.linalg.solve(matrix.conj(), b), atol=1e-10)
    state, options = SOLVER.transpose(state, options)
    np.testing.assert_allclose(SOLVER.compute(state, b, options)[0], np.linalg.solve(matrix.conj().T, b), atol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["real", "hermitian"])
def test_derivatives_under_vmap_of_first_and_second_order(rng, kind):
    """By operator and vector, beside those of `jnp.linalg.solve`."""
    matrices, changes = (jnp.asarray([matrix_of(kind, rng) for _ in range(3)]) for _ in range(2))
    b, d_b = (jnp.asarray(x) for x in rng.standard_normal((2, 3, N)).astype(matrices.dtype))
    tag = lx.positive_semidefinite_tag if kind == "hermitian" else lx.symmetric_tag

    def solve(matrix, b):
        return lx.linear_solve(lx.MatrixLinearOperator(matrix, tag), b, SOLVER).value

    @eqx.filter_jit
    def derivatives(solve):
        def of_one(matrix, change, b, d_b):
            def forward(matrix, b):
                return jax.jvp(solve, (matrix, b), (change, d_b))

            def size(matrix, b):
                return jnp.vdot(solve(matrix, b), solve(matrix, b)).real

            slope = jnp.vdot(jax.grad(size)(matrix, b).conj(), change).real
            return jax.jvp(forward, (matrix, b), (change, d_b)), slope

        return jax.vmap(of_one)(matrices, changes, b, d_b)

    found, expected = derivatives(solve), derivatives(jnp.linalg.solve)
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-7, atol=1e-8), found, expected)


@pytest.mark.slow
def test_sparse_operators_of_which_one_is_large(rng):
    """Not made full, which would take 1600² numbers."""
    n = 40
    line = sp.diags([-1.0, 2.0, -1.0], [-1, 0, 1], shape=(n, n))
    K = sp.kron(line, sp.eye(n)) + sp.kron(sp.eye(n), line)
    operator = hj.SparseLinearOperator(K, 0.51) + lx.DiagonalLinearOperator(jnp.full(n * n, -0.02))
    b = rng.standard_normal(n * n)
    x = lx.linear_solve(operator, jnp.asarray(b), SOLVER).value
    assert np.abs(K @ x - 0.53 * x - b).max() < 1e-12 * np.abs(x).max()


@pytest.mark.slow
def test_gradient_by_the_entries_of_a_sparse_operator_and_a_state_used_twice(rng):
    K, M = indefinite(60)
    pencil, b = hj.sparse_pencil(K, M), jnp.asarray(rng.standard_normal(60))
    change = jnp.asarray(rng.standard_normal(60))

    @jax.jit
    def value(diagonal):
        moved = pencil.with_stiffness(pencil.stiffness.plus(diagonal))
        operator = hj.SparseLinearOperator(moved, 0.3)
        state = SOLVER.init(jax.lax.stop_gradient(operator), {})
        return sum(jnp.sum(lx.linear_solve(operator, r, SOLVER, state=state).value) for r in (b, b**2))

    inverse = np.linalg.inv((K - 0.3 * M).toarray())
    x = inverse @ (b + b**2)
    np.testing.assert_allclose(value(jnp.zeros(60)), np.sum(x), rtol=1e-9)
    slope = jnp.vdot(jax.grad(value)(jnp.zeros(60)), change)
    np.testing.assert_allclose(slope, -np.ones(60) @ inverse @ (change * x), rtol=1e-8)


def test_vectors_that_are_trees_and_operators_on_them():
    tree = {"a": jnp.array([3.0, 1.0]), "b": jnp.array(4.0)}
    diagonal = lx.DiagonalLinearOperator({"a": jnp.array([2.0, -4.0]), "b": jnp.array(8.0)})
    x = lx.linear_solve(diagonal, tree, SOLVER).value
    np.testing.assert_allclose(x["a"], [1.5, -0.25])
    np.testing.assert_allclose(x["b"], 0.5)


@pytest.mark.slow
def test_what_lineax_asks_of_a_sparse_operator(rng):
    operator = hj.SparseLinearOperator(indefinite(7)[0], 0.1)
    matrix, x = operator.as_matrix(), jnp.asarray(rng.standard_normal(7))
    np.testing.assert_allclose(operator.T.mv(x), matrix.T @ x, atol=1e-14)
    np.testing.assert_allclose(lx.diagonal(operator), jnp.diagonal(matrix))
    for band, offset in zip(lx.tridiagonal(operator), (0, -1, 1), strict=True):
        np.testing.assert_allclose(band, jnp.diagonal(matrix, offset))
    for same in (lx.linearise, lx.materialise, lx.conj):
        assert same(operator) is operator
    assert lx.is_symmetric(operator)
    assert not any(ask(operator) for ask in (lx.is_diagonal, lx.is_positive_semidefinite, lx.has_unit_diagonal))


def test_operators_that_are_singular_or_of_no_symmetry():
    singular = lx.MatrixLinearOperator(jnp.ones((3, 3)), lx.symmetric_tag)
    solution = lx.linear_solve(singular, jnp.ones(3), SOLVER, throw=False)
    assert solution.result == lx.RESULTS.singular
    assert np.isnan(solution.value).all()
    with pytest.raises(ValueError, match="operator: got a singular matrix with 2 null vector"):
        SOLVER.init(singular, {})
    with pytest.raises(ValueError, match="not known to be symmetric or Hermitian"):
        lx.linear_solve(lx.MatrixLinearOperator(jnp.eye(3)), jnp.ones(3), SOLVER)
