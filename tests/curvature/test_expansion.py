"""The finite element HKS against the short-time expansion: the error falls at the order of the first missing term.

The grid's bias, O(h²/t), is removed by Richardson extrapolation from two grids. `test_curvature.py` holds the
coefficients themselves against a spectrally exact heat kernel.
"""

import jax.numpy as jnp
import numpy as np
import pytest

import hks_jax as hj

PERIOD = 2 * np.pi


def torus(x):
    return jnp.diag(jnp.stack([(2 + jnp.cos(x[1])) ** 2, jnp.ones_like(x[1])]))


def wavy(x):
    """A sheared metric with a conformal factor: curvature of both signs, off-diagonal components."""
    factor = jnp.exp(0.3 * (jnp.cos(x[0]) + jnp.sin(x[0] + x[1])))
    return factor * jnp.array([[1.0, 0.3], [0.3, 1.2]])


def sphere(x):
    """The unit sphere, stereographic."""
    return 4 / (1 + x @ x) ** 2 * jnp.eye(2)


CASES = {
    "torus": (torus, lambda n: hj.Grid((2 * n, n), PERIOD / np.array([2 * n, n])), "periodic", 24, 350, [0.25, 0.5]),
    "wavy": (wavy, lambda n: hj.Grid((n, n), PERIOD / n), "periodic", 32, 300, [0.15, 0.3]),
    "sphere": (sphere, lambda n: hj.Grid.from_bounds(-2.5, 2.5, (n + 1, n + 1)), "neumann", 60, 100, [0.2, 0.4]),
}


def extrapolated(case: str) -> tuple[np.ndarray, list[np.ndarray], hj.TensorField]:
    """4πt·HKS without its O(h²) error, the expansion to orders 0 … 3, both on the coarse grid's chosen nodes."""
    metric, grid, boundary, n, k, times = CASES[case]
    coarse, fine = (hj.TensorField.from_function(metric, grid(m)) for m in (n, 2 * n))
    on_coarse, on_fine = (np.asarray(hj.hks(hj.eigenpairs(f, k, boundary), times, "flat")) for f in (coarse, fine))
    signature = (4 * on_fine[:, ::2, ::2] - on_coarse) / 3
    chosen = np.linalg.norm(coarse.grid.nodes, axis=-1) < 0.2 if case == "sphere" else np.ones(coarse.grid.shape, bool)
    scale = 4 * np.pi * np.array(times)[:, None, None]
    expansions = [np.asarray(scale * hj.hks_expansion(coarse, times, order=order)) for order in range(4)]
    return signature[:, chosen], [e[:, chosen] for e in expansions], coarse


@pytest.mark.filterwarnings("ignore:k =")  # the torus and the sphere have multiple eigenvalues wherever k cuts
@pytest.mark.slow
@pytest.mark.parametrize("case", ["sphere", "torus", "wavy"])
def test_error_falls_at_the_order_of_the_first_missing_term(case):
    signature, expansions, field = extrapolated(case)
    errors = np.array([np.abs(signature - expansion).max(axis=1) for expansion in expansions])
    orders = np.log2(errors[:, 1] / errors[:, 0])
    for missing in (1, 2, 3):
        assert orders[missing - 1] == pytest.approx(missing, abs=0.45)
    assert (np.diff(errors[:, 0]) < 0).all()

    # The paper's u₂ = (4K² − 3ΔK)/45 in place of (K² − ΔK)/15 leaves an error of order t², not t³.
    t = np.array(CASES[case][5])
    chosen = np.linalg.norm(field.grid.nodes, axis=-1) < 0.2 if case == "sphere" else np.ones(field.grid.shape, bool)
    K = np.asarray(hj.gaussian_curvature(field))[chosen]
    printed = expansions[2] + (4 / 45 - 1 / 15) * K**2 * t[:, None] ** 2
    wrong = np.abs(signature - printed).max(axis=1)
    assert wrong[0] > 1.3 * errors[2, 0]
    if case == "sphere":  # constant curvature: no other term of order t² or t³ blurs the picture
        assert wrong[0] > 5 * errors[2, 0]
        assert np.log2(wrong[1] / wrong[0]) < 2.2
