"""The influence of the boundary: closed forms, its estimate from one problem, and default times that end by it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fields import flat

import hks_jax as hj
from hks_jax.signatures.rim import free_share, half_free, influence_of
from hks_jax.signatures.spans import resolved_span
from hks_jax.signatures.times import LAST, suitable

STRIP = (("neumann", "periodic"), ("dirichlet", "periodic"), (("neumann", "dirichlet"), "periodic"))


def in_a_strip(x, times):
    """The influence of the sides 0 and 1 of a flat strip, by images: Σ exp(−(x − n)²/t) / Σ exp(−n²/t)."""
    n = np.arange(-30, 31)[:, None, None]
    t = np.asarray(times)[:, None]
    return np.exp(-((x - n) ** 2) / t).sum(axis=0) / np.exp(-(n**2) / t).sum(axis=0)


@pytest.fixture(scope="module")
def strip():
    return flat((41, 4), (1.0, 0.1), (False, True))


@pytest.mark.parametrize("boundary", STRIP)
def test_the_estimate_of_one_problem_is_the_influence_of_straight_sides(strip, boundary):
    times = [0.005, 0.02, 0.05]
    pairs = hj.eigenpairs(strip, 40, boundary, solver="dense", multiplet="drop")
    found = np.asarray(influence_of(pairs, jnp.asarray(times)))[..., 0]
    expected = in_a_strip(np.linspace(0, 1, 41), times)
    assert np.array_equal(found[:, [0, -1]], np.ones((3, 2)))
    felt = expected > 0.02
    np.testing.assert_allclose(found[felt], expected[felt], rtol=0.5)  # where both sides act; else 15 %
    np.testing.assert_allclose(found[0][felt[0]], expected[0][felt[0]], rtol=0.15)
    assert (found[~felt] < 0.05).all()
    with pytest.warns(hj.AccuracyWarning):  # for so small times as the public function warns of
        assert np.isfinite(hj.boundary_influence(pairs, [1e-5])).all()


def test_the_estimate_is_right_at_times_as_small_as_the_squared_node_distance():
    pairs = hj.eigenpairs(flat((24, 5), (23.0, 5.0), (False, True)), 12, STRIP[0])
    times = np.array([1.5, 3.0, 6.0])
    found = np.asarray(influence_of(pairs, jnp.asarray(times)))[..., 0]
    np.testing.assert_allclose(found[:, :8], np.exp(-(np.arange(8) ** 2) / times[:, None]), atol=0.015)


@pytest.mark.slow
def test_the_estimate_has_the_influence_of_a_round_rim():
    """Against the eigenpairs of both problems; the default times end where half of the nodes are free."""
    x, y = np.meshgrid(*[np.linspace(-1, 1, 31)] * 2, indexing="ij")
    grid = hj.Grid((31, 31), 1 / 15, -1.0, mask=np.hypot(x, y) < 0.97)
    field = hj.TensorField(grid, np.broadcast_to(np.diag([4.0, 4.0]), (31, 31, 2, 2)))
    mean, one = (
        hj.eigenpairs(field, k, boundary, solver="dense", multiplet="drop")
        for k, boundary in ((300, "mean"), (12, "neumann"))
    )
    times = jnp.array([0.08, 0.2])
    exact, estimate = (np.asarray(influence_of(pairs, times)) for pairs in (mean, one))
    felt = (exact > 0.03) & (exact < 0.9)
    assert 0.9 < np.quantile(estimate[felt] / exact[felt], 0.1) < np.quantile(estimate[felt] / exact[felt], 0.9) < 1.35
    shares = [np.asarray(free_share(of, mean.space)) for of in (exact, estimate)]
    np.testing.assert_allclose(*shares, atol=0.03)
    assert np.isnan(estimate[:, 0, 0]).all()
    last = hj.boundary_influence(mean, hj.default_times(mean, 3))[-1]
    assert np.mean(np.asarray(last)[mean.space.domain] < 0.1) == pytest.approx(0.5, abs=0.03)
    # With 12 pairs no resolved time is so small, and the times are the least ones.
    assert float(hj.default_times(one, 3)[-1] / hj.default_times(one, 3)[0]) == pytest.approx(2)


@pytest.mark.parametrize("boundary", [pytest.param(("mean", "periodic"), marks=pytest.mark.slow), STRIP[0]])
def test_default_times_end_where_half_of_the_nodes_are_free(strip, boundary):
    """In a strip of width 1, half of the nodes are farther than 1/4 from the sides: exp(−1/16t) = 1/10."""
    pairs = hj.eigenpairs(strip, 60, boundary, solver="dense", multiplet="drop")
    expected = 1 / (16 * np.log(10))
    first = 4 * np.log(10) / float(pairs.eigenvalues[-1])
    times = np.asarray(hj.default_times(pairs, 5))
    np.testing.assert_allclose(times, np.geomspace(first, expected, 5), rtol=0.15)  # of 41 nodes
    own = np.asarray(resolved_span(pairs, 5))
    assert own[-1] == pytest.approx(expected, rel=0.15)
    assert float(hj.truncation(pairs, own).tail.max()) < 0.0101


def test_without_a_boundary_the_spectrum_ends_the_times():
    for domain, boundary in (
        (hj.examples.sphere_mesh(4), "neumann"),
        (flat((9, 9), (1.0, 1.0), (True,) * 2), "periodic"),
    ):
        pairs = hj.eigenpairs(domain, 20, boundary, solver="dense", multiplet="drop")
        positive = float(pairs.eigenvalues[1])
        assert float(hj.default_times(pairs, 4)[-1]) == pytest.approx(4 * np.log(10) / positive, rel=1e-6)
        times = resolved_span(pairs, 4)
        assert float(times[-1]) == pytest.approx(max(np.pi**2 / 9 / positive, 2 * float(times[0])), rel=1e-6)
        assert not np.asarray(hj.boundary_influence(pairs, [1.0])).any()


@pytest.mark.slow
def test_default_times_are_the_same_when_traced(strip):
    def last(tensors):
        pairs = hj.eigenpairs(hj.TensorField(strip.grid, tensors), 40, STRIP[0], solver="dense", multiplet="drop")
        return hj.default_times(pairs, 3)

    np.testing.assert_allclose(jax.jit(last)(strip.tensors), last(strip.tensors), rtol=1e-5)


def test_a_boundary_that_is_not_known_is_refused_and_does_not_end_times(strip):
    pencil = hj.assemble(strip, STRIP[0])
    pairs = hj.eigenpairs(hj.sparse_pencil(pencil.stiffness.to_scipy(), pencil.mass.to_scipy(), dimension=2), 12)
    potential = hj.eigenpairs(hj.assemble(strip, STRIP[0], potential=50.0), 12)
    for each in (pairs, potential):
        with pytest.raises(ValueError, match="eigenpairs of other matrices or, of one problem, with a potential"):
            influence_of(each, jnp.array([0.1]))
        assert float(half_free(each, 0.1, 5.0)) == 5.0


def test_a_constant_potential_does_not_change_the_influence_of_the_boundary(strip):
    plain, potential = (hj.eigenpairs(hj.assemble(strip, "mean", **own), 40) for own in ({}, {"potential": 50.0}))
    t = jnp.array([0.2, 0.5])
    np.testing.assert_allclose(influence_of(potential, t), influence_of(plain, t), atol=1e-9)


def test_times_that_suit_a_domain_do_not_depend_on_the_seam_of_a_periodic_axis():
    mask = np.zeros((24, 15), bool)
    mask[4:20, 3:12] = True
    metric, around = np.tile(np.diag([4.0, 1.0]), (mask.sum(), 1, 1)), ("periodic", "neumann")

    def times(mask, boundary):
        found = suitable(metric, (0.5, 1.0), mask, boundary)
        return found["time_by_size"], found["largest_time"]

    np.testing.assert_allclose(times(np.roll(mask, 10, axis=0), around), times(mask, "neumann"), rtol=1e-12)
    band = np.zeros((24, 15), bool)
    band[:, 3:12] = True
    metric = np.tile(np.diag([4.0, 1.0]), (band.sum(), 1, 1))
    # A circle of length 24 has the first eigenvalue (π/12)², that of an interval of length 12.
    assert times(band, around)[0] == pytest.approx(LAST * (12 / np.pi) ** 2)
    assert times(band, "neumann")[0] == pytest.approx(LAST * (23 / np.pi) ** 2)
