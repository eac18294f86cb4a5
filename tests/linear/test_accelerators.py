"""Programs as they are arranged for accelerators, run on a CPU."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fields import random_spd
from scipy.spatial import ConvexHull

import hks_jax as hj
from hks_jax.fem.stencil import Stencil
from hks_jax.linear import accelerators, dissection
from hks_jax.linear.chebyshev import chebyshev_iteration
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
