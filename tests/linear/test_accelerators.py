"""Programs as they are arranged for accelerators, run on a CPU."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fields import random_spd
from scipy.spatial import ConvexHull

import hks_jax as hj
from hks_jax.eigen.lanczos import krylov_basis
from hks_jax.fem.stencil import Stencil
from hks_jax.linear import accelerators, column_kernels, dissection, symmetric_inverse
from hks_jax.linear.chebyshev import chebyshev_iteration
from hks_jax.linear.column_kernels import orthonormal, parts_of_products, remainder
from hks_jax.linear.dissection import dissect
from hks_jax.linear.multifrontal import factorise


@pytest.fixture
def as_on_an_accelerator(monkeypatch):
    jax.clear_caches()
    monkeypatch.setattr(accelerators, "at_hand", lambda: True)
    yield
    jax.clear_caches()


def residual_and_orthogonality(pairs):
    K, M = (np.asarray(matrix.to_dense()) for matrix in (pairs.pencil.stiffness, pairs.pencil.mass))
    vectors, values = np.asarray(pairs.vectors), np.asarray(pairs.eigenvalues)
    residual = np.abs(vectors @ K - values[:, None] * (vectors @ M)).max() / np.abs(values).max()
    return residual, np.abs(vectors @ M @ vectors.T - np.eye(pairs.k)).max()


@pytest.mark.slow
@pytest.mark.parametrize("traced", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_block_lanczos_in_several_slices(rng, as_on_an_accelerator, traced):
    field = hj.TensorField(hj.Grid((18, 16), 0.1), random_spd(rng, (18, 16)))
    solve = partial(hj.eigenpairs, k=24, solver=hj.BlockLanczos(block=4, slice_size=12))
    pairs = jax.jit(solve)(field) if traced else solve(field)
    assert pairs.complete_below > pairs.eigenvalues[-1]
    assert pairs.converged.all()
    residual, orthogonality = residual_and_orthogonality(pairs)
    assert residual < 1e-9
    assert orthogonality < 1e-9


@pytest.mark.slow
def test_a_batch_is_solved_as_its_problems_are(rng, as_on_an_accelerator):
    tensors = jnp.asarray(np.stack([random_spd(rng, (14, 13)) for _ in range(2)]))

    def solve(tensors):
        return hj.eigenpairs(hj.TensorField(hj.Grid((14, 13)), tensors), 6, solver="block-lanczos").eigenvalues

    together = jax.jit(jax.vmap(solve))(tensors)
    np.testing.assert_allclose(together, [solve(each) for each in tensors], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("degree", [1, 2, 5, 8])
def test_chebyshev_iterations_are_those_of_cpus(rng, monkeypatch, degree):
    coefficients, w = jnp.asarray(rng.standard_normal((9, 6, 7))), jnp.asarray(rng.standard_normal((6, 7, 3)))
    edges = np.pad(np.ones((4, 5)), 1)[None]  # what reaches across a side is zero
    values = []
    for answer in (False, True):
        monkeypatch.setattr(accelerators, "at_hand", lambda answer=answer: answer)
        product = Stencil(0.1 * edges * coefficients, (False, False)).of_columns()
        values.append(chebyshev_iteration(product, w, jnp.asarray(2.0), jnp.asarray(7.0), jnp.zeros(3), degree))
    np.testing.assert_allclose(*values, rtol=1e-13)


@pytest.mark.slow
def test_refined_solves_are_those_of_cpus(rng, monkeypatch):
    """On a thin domain factorisations are inaccurate, and solves repeated."""
    field = hj.TensorField(hj.Grid((4, 200), (0.01, 1.0)), jnp.broadcast_to(jnp.eye(2), (4, 200, 2, 2)))
    values = []
    for answer in (False, True):
        monkeypatch.setattr(accelerators, "at_hand", lambda answer=answer: answer)
        jax.clear_caches()
        with pytest.warns(hj.AccuracyWarning):
            values.append(hj.eigenpairs(field, 7, solver="block-lanczos").eigenvalues)
    np.testing.assert_allclose(*values, atol=1e-6 * values[0][1])


@pytest.fixture
def interpreted(monkeypatch):
    monkeypatch.setattr(accelerators, "INTERPRETED", True)


def pencil_of(rng, domain):
    if domain == "mesh":
        points = rng.standard_normal((300, 3))
        points /= np.linalg.norm(points, axis=1)[:, None]
        return hj.assemble(hj.SurfaceMesh(points, ConvexHull(points).simplices))
    mask = rng.random((20, 23)) > 0.1 if domain == "mask" else None
    return hj.assemble(hj.TensorField(hj.Grid((20, 23), 0.1, mask=mask), random_spd(rng, (20, 23))))


@pytest.mark.slow
@pytest.mark.parametrize("traffic", [100.0, 1e4, pytest.param(1e9, marks=pytest.mark.slow)])
@pytest.mark.parametrize("domain", ["mask", "mesh"])
def test_merged_levels_solve_as_the_tree_does(rng, monkeypatch, domain, traffic):
    pencil = pencil_of(rng, domain)
    tree = dissect(pencil.pattern)
    monkeypatch.setattr(dissection, "_TRAFFIC", traffic)
    groups = dissection.divided(tree.levels, pencil.size)
    assert (len(groups) < len(tree.levels)) == (traffic > 100)
    assert (len(groups) == 1) == (traffic > 1e4)
    matrix, rhs = pencil.shifted(jnp.asarray(40.0)), jnp.asarray(rng.standard_normal((pencil.size, 3)))
    plain = factorise(tree, matrix)
    several = factorise(tree._replace(merged=dissection.merged(tree.levels, pencil.size)), matrix)
    assert several.negative == plain.negative
    exact = np.linalg.solve(pencil.stiffness.to_dense() - 40 * pencil.mass.to_dense(), rhs)
    for factor in (plain, several):
        np.testing.assert_allclose(factor.solve(rhs), exact, atol=1e-10 * np.abs(exact).max())


@pytest.mark.parametrize(
    ("n", "b", "dtype"),
    [
        (1, 1, float),
        (300, 8, np.float32),
        *(pytest.param(*c, float, marks=pytest.mark.slow) for c in [(1100, 8), (70, 20)]),
    ],
)
def test_kernels_of_columns(rng, interpreted, n, b, dtype):
    x, y, z = (jnp.asarray(rng.standard_normal((n, b)).astype(dtype)) for _ in range(3))
    mix, tolerance = jnp.asarray(rng.standard_normal((b, b)).astype(dtype)), 1e4 * np.finfo(dtype).eps
    parts = parts_of_products(y, x)
    products = np.asarray(y).T @ np.asarray(x)
    np.testing.assert_allclose(jnp.sum(parts, axis=0), products, atol=tolerance)
    rest, total = remainder(x, y, parts)
    np.testing.assert_allclose(total, products, atol=tolerance)
    np.testing.assert_allclose(rest, x - y @ products, rtol=tolerance, atol=n * tolerance)
    rest, total = remainder(x, y, parts, (z, mix))
    np.testing.assert_allclose(total, (products + products.T) / 2, atol=tolerance)
    np.testing.assert_allclose(rest, x - y @ total - z @ mix, rtol=tolerance, atol=n * tolerance)


@pytest.mark.slow
def test_the_recurrence_by_kernels_is_the_plain_one(rng, interpreted, monkeypatch):
    pencil = pencil_of(rng, "mask")
    mass = pencil.mass.of_columns()
    x, before = (jnp.asarray(rng.standard_normal((pencil.size, 4))) for _ in range(2))
    block, image, factor = krylov_basis.orthonormal(mass, before)
    plain = krylov_basis.recur(block, image, before, factor, x), krylov_basis.without(block, image, x)
    monkeypatch.setattr(krylov_basis, "_one_of", lambda by_kernels, plain, x: by_kernels())
    by_kernels = krylov_basis.recur(block, image, before, factor, x), krylov_basis.without(block, image, x)
    for one, other in zip(jax.tree.leaves(plain), jax.tree.leaves(by_kernels), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-12)
    y, image, factor = krylov_basis.orthonormal(mass, before)
    np.testing.assert_allclose(y.T @ mass(y), np.eye(4), atol=1e-14)
    np.testing.assert_allclose(image, mass(y), atol=1e-14)
    np.testing.assert_allclose(y @ factor.T, before, atol=1e-13)


def factor_by_kernel(products):
    """Return F with FFᵀ = G, and F⁻ᵀ."""
    identity = jnp.eye(len(products), dtype=products.dtype)
    (change,), factor = orthonormal(jnp.asarray(products)[None], (identity,), identity)
    return np.asarray(factor), np.asarray(change)


@pytest.mark.parametrize(("b", "dtype"), [(1, float), (8, float), (8, np.float32), (20, float)])
def test_factor_of_a_gram_matrix(rng, interpreted, b, dtype):
    x = (rng.standard_normal((100, b)) * 10.0 ** rng.uniform(-3, 3, b)).astype(dtype)
    products = x.T @ x
    factor, change = factor_by_kernel(products)
    norms, eps = np.sqrt(np.diag(products)), np.finfo(dtype).eps
    np.testing.assert_allclose(
        factor @ factor.T / norms / norms[:, None], products / norms / norms[:, None], atol=50 * eps
    )
    np.testing.assert_allclose((x @ change).T @ (x @ change), np.eye(b), atol=1e4 * eps)
    np.testing.assert_allclose(factor.T @ change, np.eye(b), atol=1e3 * eps)


def test_dependent_columns_become_orthonormal_in_two_passes(rng, interpreted):
    x = rng.standard_normal((100, 8))
    x[:, 5] = x[:, 2] + 1e-13 * x[:, 5]
    x[:, 6] = x[:, 0] - 3 * x[:, 1]
    x[:, 7] = 0
    for _ in range(2):
        x = x @ factor_by_kernel(x.T @ x)[1]
    products = x.T @ x
    assert np.isfinite(x).all()
    np.testing.assert_allclose(products[:5, :5], np.eye(5), atol=1e-8)
    assert np.abs(products).max() < 10


@pytest.mark.parametrize("dtype", [np.float32, pytest.param(np.float64, marks=pytest.mark.slow)])
def test_kernels_prove_themselves_at_the_first_use(dtype, interpreted, monkeypatch):
    if accelerators.at_hand():
        pytest.skip("the kernels compile here: this test needs a device on which they do not")
    monkeypatch.setattr(accelerators, "_PROVED", {})
    assert not column_kernels.agree(dtype)  # no GPU here, and nothing to prove
    monkeypatch.setattr(accelerators, "kernels_compile", lambda: True)
    assert jax.jit(lambda: jnp.asarray(column_kernels.agree(dtype)))()  # while a program is traced
    assert symmetric_inverse._kernel_agrees(dtype)
    right = column_kernels.parts_of_products
    monkeypatch.setattr(column_kernels, "parts_of_products", lambda x, y: 1.01 * right(x, y))
    assert column_kernels.agree(dtype)  # once in a process
    accelerators._PROVED.clear()
    with pytest.warns(RuntimeWarning, match=r"on cpu the kernels of block Lanczos in float\d\d have a relative error"):
        assert not column_kernels.agree(dtype)
    assert not column_kernels.agree(dtype)  # told once
    monkeypatch.setattr(accelerators, "INTERPRETED", False)
    with pytest.warns(RuntimeWarning, match=r"kernels of inverses in float\d\d do not compile \("):
        assert not symmetric_inverse._kernel_agrees(dtype)  # Pallas compiles nothing for a CPU
