"""The whole path in float32, JAX's default, in a process of its own, and the accuracy to expect of it."""

import subprocess
import sys
import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
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
