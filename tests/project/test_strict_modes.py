"""The settings with which people look for their own mistakes must not find ours."""

import os
import subprocess
import sys

import pytest

SCRIPT = """
import jax, jax.numpy as jnp, numpy as np, scipy.sparse as sp
import hks_jax as hj

x = np.indices((9, 9)) - 4
grid = hj.Grid((9, 9), 1.0, mask=np.hypot(*x) < 4.2)
tensors = jnp.broadcast_to(jnp.eye(2), (9, 9, 2, 2)) * jnp.exp(0.05 * x[0])[..., None, None]

def signature(tensors):
    pairs = hj.eigenpairs(hj.TensorField(grid, tensors), 8, "mean", "dense", multiplet="drop")
    return hj.hks(pairs, jnp.array([8.0, 16.0]))

values = np.asarray(signature(tensors))
gradient = jax.grad(lambda T: jnp.nansum(signature(T)))(tensors)
assert np.isnan(values[:, 0, 0]).all() and np.isfinite(values[:, 4, 4]).all() and jnp.isfinite(gradient).all()
pairs = hj.eigenpairs(hj.TensorField(grid, tensors), 8)
assert pairs.eigenfunctions.shape == (8, 9, 9)
results = hj.wks(pairs, jnp.array([-1.0]), 0.5), hj.truncation_map(pairs, [8.0]), hj.biharmonic_distance(pairs, [4, 4])
for result in map(np.asarray, results):
    assert np.isnan(result[..., 0, 0]).all() and np.isfinite(result[..., 4, 4]).all()
assert np.isnan(np.asarray(hj.gaussian_curvature(hj.TensorField(grid, tensors)))[0, 0])
K = sp.diags([-1.0, 2.0, -1.0], [-1, 0, 1], shape=(1200, 1200)).tocsr()
np.testing.assert_allclose(hj.eigsh(K, k=3).eigenvalues, 2 - 2 * np.cos(np.pi * np.arange(1, 4) / 1201), rtol=1e-6)
assert hj.eigsh(K[:60, :60], interval=(0.5, 0.7)).k == 2
"""


@pytest.mark.slow
def test_debug_nans_and_rank_promotion_find_nothing_in_masked_fields_and_matrices():
    modes = {
        "JAX_DEBUG_NANS": "1",
        "JAX_NUMPY_RANK_PROMOTION": "raise",
        "JAX_ENABLE_X64": "1",
        "OPENBLAS_NUM_THREADS": "1",
    }
    command = [sys.executable, "-W", "ignore", "-c", SCRIPT]
    done = subprocess.run(command, env=os.environ | modes, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
