"""Zeta-regularised determinants against closed forms."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse as sp
from annotations import unchecked
from differences import directional
from scipy.special import jn_zeros

import hks_jax as hj

LOG_GLAISHER = 0.24875447703378424
"""1/12 − ζ′(−1)."""
SLOPE = 1 / 12 - LOG_GLAISHER
"""ζ′(−1)."""


def torus(a, b):
    """log det′ of the flat torus a × b: log(a² |η(ia/b)|⁴), η Dedekind's."""
    y, n = a / b, np.arange(1, 80)
    logarithm = -np.pi * y / 12 + np.sum(np.log1p(-np.exp(-2 * np.pi * n * y)))
    return 2 * np.log(a) + 4 * logarithm


def rectangle(a, b, sign):
    """Even and odd functions on the torus 2a × 2b, and on circles: sign is 1 for Neumann, −1 for Dirichlet."""
    return torus(2 * a, 2 * b) / 4 + sign * (np.log(2 * a) + np.log(2 * b)) / 2


def pairs_with(values, volume):
    """Pairs of a surface whose spectrum is known, up to the end of a multiplet; of the vectors nothing is needed."""
    pairs = hj.eigenpairs(hj.sparse_pencil(sp.diags(np.arange(6.0)), dimension=2, volume=volume), 6, solver="dense")
    values = np.sort(values)
    k = 1 + int(np.flatnonzero(np.diff(values[:400]) > 1e-9 * values[399])[-1])
    replaced = jnp.asarray(values[:k]), jnp.ones(k, bool), jnp.asarray(values[k])
    return eqx.tree_at(lambda p: (p.eigenvalues, p.kept, p.next_eigenvalue), pairs, replaced)


def of_product(a, b, numbers):
    squares = np.square(numbers * np.pi)
    return (squares[:, None] / a**2 + squares[None] / b**2).ravel()


SIDES = (1.3, 2.0)
QUARTERS = [np.pi / 2] * 4
WHOLE = np.arange(40)


@pytest.mark.parametrize(
    ("values", "rim", "expected"),
    [
        (of_product(*SIDES, 2 * np.arange(-30, 31)), {"euler_characteristic": 0}, torus(*SIDES)),
        (
            of_product(*SIDES, WHOLE),
            {"euler_characteristic": 1, "boundary_length": 6.6, "corners": QUARTERS},
            rectangle(*SIDES, 1),
        ),
        (
            of_product(*SIDES, WHOLE[1:]),
            {"euler_characteristic": 1, "boundary_length": 6.6, "corners": QUARTERS, "condition": "dirichlet"},
            rectangle(*SIDES, -1),
        ),
    ],
    ids=["torus", "rectangle, Neumann", "rectangle, Dirichlet"],
)
def test_flat_tori_and_rectangles(values, rim, expected):
    pairs = pairs_with(values, SIDES[0] * SIDES[1])
    found = hj.log_determinant(pairs, hj.heat_coefficients(pairs, **rim))
    assert abs(found.value - expected) < 1e-7
    assert abs(found.value - expected) < 1.5 * found.error + 1e-12
    assert found.error < 1e-4


@pytest.mark.slow
def test_the_sphere_with_powers_that_are_extrapolated_or_known():
    """½ − 4ζ′(−1)."""
    degrees = np.arange(21)
    pairs = pairs_with(np.repeat(degrees * (degrees + 1.0), 2 * degrees + 1), 4 * np.pi)
    known = hj.heat_coefficients(pairs, 2)
    for powers, accuracy in (((), 5e-3), ((1,), 5e-5), ((1, 2), 2e-6)):
        found = hj.log_determinant(pairs, known, extrapolate=powers)
        assert abs(found.value - (0.5 - 4 * SLOPE)) < min(accuracy, found.error)
    expansion = [1, 0, 1 / 3, 0, 1 / 15, 0, 4 / 315]
    np.testing.assert_allclose(
        hj.log_determinant(pairs, expansion, extrapolate=(3, 4)).value, 0.5 - 4 * SLOPE, atol=1e-8
    )
    cut = pairs.eigenvalues[:36], jnp.ones(36, bool), pairs.eigenvalues[36]
    few = eqx.tree_at(lambda p: (p.eigenvalues, p.kept, p.next_eigenvalue), pairs, cut)
    with pytest.warns(hj.AccuracyWarning, match="has the estimated error"):
        found = hj.log_determinant(few, known, extrapolate=(1, 2))  # the levels cross near T = 1.7
    assert abs(found.value - (0.5 - 4 * SLOPE)) < found.error


def test_the_disc_whose_rim_is_curved():
    """−5/12 − 2ζ′(−1) − ½ log π − ⅙ log 2 under Dirichlet conditions (Weisberger 1987)."""
    values = np.concatenate([np.repeat(jn_zeros(n, 14) ** 2, 1 if n == 0 else 2) for n in range(45)])
    pairs = pairs_with(values, np.pi)
    known = hj.heat_coefficients(pairs, 1, 2 * np.pi, condition="dirichlet")
    found = hj.log_determinant(pairs, known, extrapolate=(0.5, 1))
    exact = -5 / 12 - 2 * SLOPE - np.log(np.pi) / 2 - np.log(2) / 6
    assert abs(found.value - exact) < 2e-5 < found.error


def flat_torus(scale, n=24):
    metric = jnp.broadcast_to(jnp.diag(jnp.asarray([scale, 1.0])), (n, n, 2, 2))
    return hj.TensorField(hj.Grid((n, n), 1 / n), metric)


@pytest.mark.slow
def test_of_elements_with_the_derivative_by_the_metric():
    """A torus √s × 1, periodic: the value within its estimate, which the spacing makes; the slope by differences."""

    @jax.jit
    def value(scale):
        pairs = hj.eigenpairs(flat_torus(scale), 121, boundary="periodic", solver="dense")
        return hj.log_determinant(pairs, hj.heat_coefficients(pairs, 0), time=0.02)

    at = jnp.asarray(1.1)
    found = value(at)
    exact = torus(np.sqrt(1.1), 1.0)
    assert abs(found.value - exact) < 1.5 * found.error
    slope = jax.jit(jax.grad(lambda s: value(s).value))(at)
    np.testing.assert_allclose(slope, directional(lambda s: value(s).value, at, 1.0, 1e-3), rtol=1e-6)
    np.testing.assert_allclose(slope, directional(lambda s: torus(np.sqrt(s), 1.0), 1.1, 1.0, 1e-3), atol=0.03)


@pytest.mark.slow
def test_pairs_that_a_compiled_function_closes_over():
    pairs = pairs_with(of_product(*SIDES, 2 * np.arange(-30, 31)), 2.6)
    known = hj.heat_coefficients(pairs, 0)
    found = jax.jit(lambda a, t: hj.log_determinant(pairs, a, time=t).value)(known, 0.02)
    np.testing.assert_allclose(found, hj.log_determinant(pairs, known, time=0.02).value, rtol=1e-12)


def test_what_is_refused_and_warned_of():
    pairs = pairs_with(of_product(*SIDES, WHOLE), 2.6)
    with pytest.raises(ValueError, match=r"coefficients: got shape \(2,\); expected at least 3"):
        hj.log_determinant(pairs, [1.0, 0.0])
    with pytest.raises(ValueError, match="extrapolate: got"):
        hj.log_determinant(pairs, [1.0, 0.0, 0.0], extrapolate=(0,))
    with unchecked(), pytest.raises(ValueError, match=r"extrapolate: got 0.5; expected a list"):
        hj.log_determinant(pairs, [1.0, 0.0, 0.0], extrapolate=0.5)
    with pytest.raises(ValueError, match=r"time: got \[0.02, 0.03\]; expected a finite number above 0"):
        hj.log_determinant(pairs, [1.0, 0.0, 0.0], time=[0.02, 0.03])
    with pytest.raises(ValueError, match=r"time: got shape \(2,\); expected one time"):
        jax.jit(lambda t: hj.log_determinant(pairs, [1.0, 0.0, 0.0], time=t).value)(jnp.array([0.02, 0.03]))
    with pytest.raises(ValueError, match="time: got 0"):
        hj.log_determinant(pairs, [1.0, 0.0, 0.0], time=0)
    with pytest.raises(ValueError, match="corners: got"):
        hj.heat_coefficients(pairs, 1, corners=[90.0])
    plane = hj.TensorField(hj.Grid((5, 5)), np.tile(np.eye(2), (5, 5, 1, 1)))
    potential = hj.eigenpairs(hj.assemble(plane, potential=3.0), 4)
    with pytest.raises(ValueError, match="got an operator with a potential"):
        hj.heat_coefficients(potential, 1)
    negative = eqx.tree_at(lambda p: p.eigenvalues, pairs, pairs.eigenvalues - 1)
    with pytest.raises(ValueError, match="expected none below zero"):
        hj.log_determinant(negative, [1.0, 0.0, 0.0])
    coefficients = hj.heat_coefficients(pairs, 2)
    for call in (lambda a: hj.log_determinant(pairs, a), jax.grad(lambda a: hj.log_determinant(pairs, a).value)):
        with pytest.warns(hj.AccuracyWarning, match="estimated error"):
            call(coefficients)
