"""The whole path in float32, JAX's default, in a process of its own, and the accuracy to expect of it."""

import subprocess
import sys
import warnings
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.sparse as sp
from fields import random_spd

import hks_jax as hj

SHAPE, K, TIMES = (16, 17), 40, [0.3, 1.0]
PROBE = np.random.default_rng(3).standard_normal((2, *SHAPE)).astype(np.float32)
CASES = [("neumann", "dense"), ("neumann", "shift-invert"), ("dirichlet", "dense")]
MORE_CASES = [("dirichlet", "shift-invert"), ("mirror", "dense"), ("mirror", "shift-invert")]

SCRIPT = """
import sys, warnings
import jax, jax.numpy as jnp, numpy as np
import hks_jax as hj
given, K, TIMES, CASES = np.load(sys.argv[1]), {K}, {TIMES}, {CASES}
warnings.simplefilter("error")
warnings.filterwarnings("ignore", "the tensors vary too much", hj.AccuracyWarning)
field, out = hj.TensorField(hj.Grid({SHAPE}, 0.1), given["tensors"]), {{}}
for boundary, solver in CASES:
    pairs = hj.eigenpairs(field, K, boundary, solver)
    name = f"{{boundary}} {{solver}} "
    assert {{leaf.dtype.name for leaf in jax.tree.leaves(pairs)}} <= {{"float32", "bool", "int32"}}
    times = jnp.array([3.0, 9.0])
    # What is computed from pairs does not depend on how they were found.
    others = []
    if (boundary, solver) != ("neumann", "shift-invert"):
        others = [hj.default_times(pairs, 4), hj.wks(pairs), hj.scale_invariant_hks(pairs), hj.heat_trace(pairs, times),
                  hj.truncation(pairs, times).tail, hj.truncation_map(pairs, times), hj.shape_dna(pairs),
                  hj.global_point_signature(pairs)]
    if (boundary, solver) == ("neumann", "dense"):
        others += [hj.biharmonic_distance(pairs, (4, 4)), hj.diffusion_distance(pairs, times, (4, 4))]
    assert all(x.dtype == jnp.float32 for x in others)
    assert all(np.isfinite(x[..., 1:-1, 1:-1] if x.ndim > 2 else x).all() for x in others)
    mass = pairs.pencil.parts[0].mass

    def loss(tensors):
        signature = hj.hks(hj.eigenpairs(hj.TensorField(field.grid, tensors), K, boundary, solver), TIMES)
        return jnp.sum(given["probe"] * signature)

    out |= {{
        name + "values": pairs.eigenvalues,
        name + "converged": pairs.converged,
        name + "hks": hj.hks(pairs, TIMES),
        name + "gradient": jax.grad(loss)(field.tensors),
        name + "slope": jax.jvp(loss, (field.tensors,), (field.tensors,))[1] if solver == "dense" else np.nan,
        name + "gram": pairs.vectors @ mass.apply(pairs.vectors).T,
    }}
np.savez(sys.argv[2], **out)
"""


def single(tensors: np.ndarray, cases: list[tuple[str, str]], folder: Path) -> dict[str, np.ndarray]:
    """Return what a float32 process computes."""
    np.savez(folder / "in.npz", tensors=tensors, probe=PROBE)
    script = SCRIPT.format(K=K, TIMES=TIMES, CASES=cases, SHAPE=SHAPE)
    command = [sys.executable, "-c", script, folder / "in.npz", folder / "out.npz"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return dict(np.load(folder / "out.npz"))


def double(tensors: np.ndarray) -> Callable[[str], tuple[hj.Eigenpairs, np.ndarray]]:
    """Return what this process computes in float64."""

    @cache
    def compute(boundary):
        def loss(T):
            pairs = hj.eigenpairs(hj.TensorField(hj.Grid(SHAPE, 0.1), T), K, boundary, "dense")
            return jnp.sum(PROBE.astype(np.float64) * hj.hks(pairs, TIMES)), pairs

        gradient, pairs = jax.grad(loss, has_aux=True)(jnp.asarray(tensors))
        return pairs, np.asarray(gradient)

    return compute


@pytest.mark.slow
@pytest.mark.parametrize("cases", [CASES, pytest.param(MORE_CASES, marks=pytest.mark.slow)], ids=["some", "others"])
def test_float32_agrees_with_float64(tmp_path, cases):
    tensors = random_spd(np.random.default_rng(32), SHAPE, 0.5)
    got, wanted = single(tensors, cases, tmp_path), double(tensors)
    for boundary, solver in cases:
        compare(got, *wanted(boundary), tensors, boundary, solver)


def compare(single, pairs, gradient, tensors, boundary, solver):
    """Assert that what the float32 process computed agrees."""
    got = {
        key: single[f"{boundary} {solver} {key}"] for key in ("values", "converged", "hks", "gradient", "slope", "gram")
    }
    assert got["converged"].all()
    assert (got["values"] >= 0).all()
    assert (got["values"][0] == 0) == (boundary != "dirichlet")
    # eps·λ_max = 6e-8 · 1e4 limits the dense solver's eigenvalues; the sparse one works in float64 on the host.
    atol = 2e-3 if solver == "dense" else 2e-4
    np.testing.assert_allclose(got["values"], pairs.eigenvalues, rtol=1e-5, atol=atol)
    assert got["hks"].dtype == np.float32
    np.testing.assert_allclose(got["hks"], hj.hks(pairs, TIMES), rtol=1e-3, atol=1e-4)
    assert got["gradient"].dtype == np.float32
    assert np.linalg.norm(got["gradient"] - gradient) < 1e-3 * np.linalg.norm(gradient)
    size = np.sum(np.abs(gradient * tensors))
    if solver == "dense":
        np.testing.assert_allclose(got["slope"], np.sum(gradient * tensors), atol=1e-3 * size)
    if boundary == "neumann":
        np.testing.assert_allclose(got["gram"], np.eye(K), atol=1e-4)


@pytest.mark.parametrize("stretch", [100.0, 6e4])
def test_tensors_that_float32_does_not_hold_are_told(stretch):
    axes = np.array([[1, -1], [1, 1]]) / np.sqrt(2)
    tensors = np.broadcast_to(axes @ np.diag([1, 1 / stretch]) @ axes.T, (16, 16, 2, 2))
    grid = hj.Grid((16, 16), 1 / 15)
    exact = hj.eigenpairs(hj.TensorField(grid, jnp.asarray(tensors)), 20).eigenvalues
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        rounded = hj.eigenpairs(hj.TensorField(grid, jnp.asarray(tensors, jnp.float32)), 20)
    known = np.flatnonzero(np.asarray(rounded.converged))[1:]
    error = np.max(np.abs(np.asarray(rounded.eigenvalues)[known] / np.asarray(exact)[known] - 1))
    said = any("which residuals do not show" in str(each.message) for each in told)
    assert (error > 5e-4, said) == (stretch > 1e3,) * 2


def laplacian(weights):
    """Return the graph Laplacian of a symmetric matrix of weights, in float32."""
    return (sp.diags(np.asarray(weights.sum(axis=1)).ravel()) - weights).tocsr().astype(np.float32)


def chain(n, weight=1.0):
    links = sp.diags(np.full(n - 1, weight), 1)
    return laplacian(links + links.T)


def cliques(bridge):
    """Return the Laplacian of two complete graphs of 20 nodes with one link between them."""
    weights = scipy.linalg.block_diag(*[np.ones((20, 20)) - np.eye(20)] * 2)
    weights[19, 20] = weights[20, 19] = bridge
    return laplacian(sp.csr_matrix(weights))


def square(n):
    tensors = jnp.broadcast_to(jnp.eye(2, dtype=jnp.float32), (n, n, 2, 2))
    return hj.TensorField(hj.Grid((n, n), 1 / (n - 1)), tensors)


def told_by(run):
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always", hj.AccuracyWarning)
        pairs = run()
    return pairs, [str(each.message) for each in told if "cuts a multiple" not in str(each.message)]


def test_eigenvalues_far_below_the_largest_are_accurate():
    spectrum = 2 - 2 * np.cos(np.pi * np.arange(4) / 3000)
    # The algebraic connectivity of two cliques of m nodes with a weak link w is 2w/m, to first order.
    for K, exact in ((chain(3000), spectrum), (cliques(1e-5), [0, 1e-6]), (cliques(1e-8), [0, 1e-9])):
        pairs, told = told_by(partial(hj.eigsh, K, k=len(exact)))
        assert (not told, pairs.eigenvalues[0], pairs.result) == (True, 0, hj.RESULTS.successful)
        np.testing.assert_allclose(pairs.eigenvalues[1:], exact[1:], rtol=2e-6)
    stated = hj.sparse_pencil(cliques(1e-5), null_vectors=np.ones((1, 40)))
    pairs, told = told_by(lambda: hj.eigenpairs(stated, 2))
    assert (not told, pairs.eigenvalues[0]) == (True, 0)
    np.testing.assert_allclose(pairs.eigenvalues[1], 1e-6, rtol=2e-6)


@pytest.mark.parametrize("operator", ["fick", "weighted"])  # NumPy assembles Fick's operator, XLA the weighted one
def test_small_eigenvalues_of_nearly_cut_domains_are_accurate(operator):
    mask, bridge = np.ones((24, 24), bool), np.ones((24, 24))
    mask[11:13, :10] = mask[11:13, 12:] = False
    bridge[11:13, 10:12] = 1e-5

    def lowest(dtype, solver):
        flat = jnp.broadcast_to(jnp.eye(2, dtype=dtype), (24, 24, 2, 2))
        grid, values = hj.Grid((24, 24), 1 / 23, mask=mask), jnp.asarray(bridge, dtype)
        if operator == "weighted":
            return hj.eigenpairs(hj.assemble(hj.TensorField(grid, flat), density=values), 2, solver=solver)
        diffusivity = values[..., None, None] * flat
        return hj.eigenpairs(hj.TensorField.from_diffusion(grid, diffusivity, operator="fick"), 2, solver=solver)

    exact = lowest(jnp.float64, "dense").eigenvalues
    for solver in ("dense", "shift-invert"):
        pairs = lowest(jnp.float32, solver)
        assert pairs.rounding[1] < 1e-6 * pairs.eigenvalues[1] < 1e-10
        np.testing.assert_allclose(pairs.eigenvalues, exact, rtol=2e-6)


@pytest.mark.parametrize(("n", "solver"), [pytest.param(33, "dense", marks=pytest.mark.slow), (65, "shift-invert")])
def test_a_small_potential_raises_the_lowest_eigenvalue(n, solver):
    for potential in (0.01, 0.1, 1.0):
        pairs, told = told_by(lambda V=potential: hj.eigenpairs(hj.assemble(square(n), potential=V), 4, solver=solver))
        error = abs(float(pairs.eigenvalues[0]) - potential)
        assert error < pairs.rounding[0] < 3e-3  # rounding of entries: ε ‖K‖/‖M‖
        # What may be off by more than 1 % is told.
        assert bool(told) == bool(pairs.uncertain[0]) == bool(pairs.rounding[0] > 0.01 * pairs.eigenvalues[0])
        assert potential < 1 or not told
        np.testing.assert_allclose(hj.hks(pairs, [0.5 / potential]), np.exp(-0.5), rtol=0.06)


def test_eigenvalues_that_float32_does_not_hold_are_told():
    pairs, (told,) = told_by(lambda: hj.eigenpairs(hj.assemble(square(33), potential=1e-5), 4))
    assert (pairs.result, bool(pairs.uncertain[0])) == (hj.RESULTS.uncertain, True)
    assert abs(pairs.eigenvalues[0] - 1e-5) < pairs.rounding[0] < 1e-2
    assert told.startswith("1 of 4 eigenvalues (λ = ")
    assert told.endswith("Use float64")
    # The rows of this K do not sum to zero, so nothing says that a null vector is meant.
    K = cliques(1e-6) + 1e-6 * sp.eye(40, dtype=np.float32)
    exact = np.linalg.eigvalsh(K.toarray().astype(float))[:2]
    pairs, (told,) = told_by(lambda: hj.eigsh(K, k=2))
    assert pairs.uncertain.all()
    assert told.endswith("Use float64, or give `sparse_pencil` the null vectors")
    np.testing.assert_allclose(pairs.eigenvalues, exact, rtol=1e-5)


@pytest.mark.slow
def test_under_jit_an_eigenvalue_near_zero_has_a_code():
    K = hj.sparse_pencil(cliques(1e-5))
    pairs = jax.jit(lambda K: hj.eigenpairs(K, 2))(K)
    assert pairs.result == hj.RESULTS.uncertain
    assert (np.abs(pairs.eigenvalues - np.float32([0, 1e-6])) < pairs.rounding).all()
    shifted = jax.jit(lambda K: hj.eigenpairs(K, 2).result)(
        hj.sparse_pencil(K.stiffness.to_dense() + np.eye(40, dtype=np.float32))
    )
    assert shifted == hj.RESULTS.successful


@pytest.mark.parametrize("boundary", ["neumann", "mean"])
def test_eigenvalues_of_ordinary_fields_are_not_doubted(rng, boundary):
    tensors = jnp.asarray(random_spd(rng, (16, 17), 0.5), jnp.float32)
    field = hj.TensorField(hj.Grid((16, 17), 0.1), tensors)
    for potential in (None, 1.0, -1.0):
        pairs, told = told_by(lambda V=potential: hj.eigenpairs(hj.assemble(field, boundary, potential=V), 12))
        assert (told, float(jnp.max(pairs.rounding))) == ([], 0)
        assert (pairs.eigenvalues[0] == 0) == (potential is None)
