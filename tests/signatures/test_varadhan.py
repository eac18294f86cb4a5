"""Varadhan's distance against known geodesic distances; and what a tunnel does to distances and to the signature."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fields import flat
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

import hks_jax as hj

N = 24
MIDDLE = (12, 12)


@pytest.fixture(scope="module")
def torus() -> tuple[hj.Eigenpairs, np.ndarray]:
    """Half of the eigenpairs of a flat torus of side 10, and the distances from its middle node."""
    field = flat((N, N), (10.0, 10.0), (True, True))
    pairs = hj.eigenpairs(field, 290, "periodic", multiplet="drop")
    return pairs, np.linalg.norm(field.grid.nodes - field.grid.nodes[MIDDLE], axis=-1)


@pytest.mark.filterwarnings("ignore::hks_jax.AccuracyWarning")
def test_flat_distances_and_why_they_are_normalised(torus):
    pairs, exact = torus
    times = np.array([2.0, 1.0])
    ours, raw = (np.asarray(hj.varadhan_distance(pairs, times, MIDDLE, normalised=n))[:, 0] for n in (True, False))
    assert np.all(ours[(slice(None), *MIDDLE)] == 0)
    near = (exact > 1) & (exact < 3)
    errors, literal = (np.abs(d[:, near] ** 2 / exact[near] ** 2 - 1).max(axis=1) for d in (ours, raw))
    # At d = 3 the elements err by d²h²/48t² = 0.8 % and 3.3 %, the other ways around the torus by less.
    assert np.all(errors < [0.02, 0.04])
    assert np.all(literal > 1)
    unit = 4 * times * np.log(4 * np.pi * times)  # the power of t before the kernel
    np.testing.assert_allclose(raw[:, near] ** 2 - unit[:, None], ours[:, near] ** 2, atol=0.05)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::hks_jax.AccuracyWarning")
def test_what_is_not_resolved_is_nan_and_said(torus):
    pairs, exact = torus
    times = np.geomspace(0.02, 2.0, 9)
    message = r"times: .*% of the distances are NaN \(.*% at t = 0.02\), because the heat kernel is not resolved"
    with pytest.warns(hj.AccuracyWarning, match=message) as seen:
        got = np.asarray(hj.varadhan_distance(pairs, times, MIDDLE))[:, 0]
    assert {warning.filename for warning in seen} == {__file__}
    near, t = np.broadcast_to(exact < 3, got.shape), times[:, None, None]
    finite = np.isfinite(got) & near
    assert 0.1 < finite.sum() / near.sum() < 0.9
    size = np.maximum(exact**2, 0.4 * t)  # the kernel's tenth is 0.4t
    assert (np.abs(got**2 - exact**2) / size)[finite].max() < 0.15
    # The formula has values where the result is NaN; they are wrong.
    kernel = np.asarray(hj.heat_kernel(pairs, times, MIDDLE)[:, 0] / hj.hks(pairs, times))
    hidden = near & ~finite
    assert (kernel[hidden] < 0).any()
    hidden &= kernel > 0
    assert np.median((np.abs(-4 * t * np.log(np.abs(kernel)) - exact**2) / size)[hidden]) > 0.15


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::hks_jax.AccuracyWarning")
def test_curved_distances_converge_with_the_known_first_order():
    """On the unit sphere u₀ = √(d/sin d): the squared distance errs by −2t log(d/sin d) + O(t²)."""
    n, times = 90, np.array([0.12, 0.06])
    # Mercator's chart: along the equator the nodes have one distance, and the sides are 75° away.
    grid = hj.Grid((n, 51), (2 * np.pi / n, 0.08), (0.0, -2.0))
    field = hj.TensorField.from_function(lambda x: jnp.eye(2) / jnp.cosh(x[1]) ** 2, grid)
    pairs = hj.eigenpairs(field, 220, ("periodic", "neumann"))
    got = np.asarray(hj.varadhan_distance(pairs, times, (0, 25)))[:, 0, :, 25]
    exact = grid.axes[0]
    near = (exact > 0.5) & (exact < 0.9)
    exact, t = exact[near], times[:, None]
    of_elements = grid.spacing[0] ** 2 * exact**2 * (exact**2 - 4 * t) / (48 * t**2)
    errors = got[:, near] ** 2 - exact**2 - of_elements
    slope = -2 * np.log(exact / np.sin(exact))
    np.testing.assert_allclose(errors / t, np.broadcast_to(slope, errors.shape), rtol=0.12)
    np.testing.assert_allclose(errors[0] / errors[1], 2, rtol=0.12)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::hks_jax.AccuracyWarning")
def test_on_a_mesh():
    n = 21
    i, j = (axis.ravel() for axis in np.indices((n - 1, n - 1)))
    a, b, c, d = i * n + j, (i + 1) * n + j, (i + 1) * n + j + 1, i * n + j + 1
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    places = np.stack([*np.meshgrid(*[np.linspace(0, 1, n)] * 2, indexing="ij"), np.zeros((n, n))], -1).reshape(-1, 3)
    pairs = hj.eigenpairs(hj.SurfaceMesh(places, faces), n * n)
    source = n * n // 2
    got = np.asarray(hj.varadhan_distance(pairs, [0.015], source))[0, 0]
    exact = np.linalg.norm(places - places[source], axis=1)
    near = exact < 0.3
    np.testing.assert_allclose(got[near], exact[near], rtol=0.06)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*did not converge")  # pairs of float32
def test_scaling_batches_jit_and_dirichlet_sides():
    field, times = flat((9, 10), (1.0, 1.1)), jnp.array([0.1, 0.2])

    def distance(tensors, times):
        return hj.varadhan_distance(hj.eigenpairs(hj.TensorField(field.grid, tensors), 90), times, [(4, 4), (0, 9)])

    one = distance(field.tensors, times)
    assert one.shape == (2, 2, 9, 10)
    np.testing.assert_allclose(one[:, 0, 0, 9], one[:, 1, 4, 4], rtol=1e-9)
    single = distance(field.tensors.astype(jnp.float32), times.astype(jnp.float32))
    assert single.dtype == jnp.float32
    np.testing.assert_allclose(single, one, rtol=2e-3)
    factors = jnp.array([1.0, 9.0])
    scaled = jax.jit(jax.vmap(lambda c: distance(c * field.tensors, c * times)))(factors)
    np.testing.assert_allclose(scaled, jnp.sqrt(factors)[:, None, None, None, None] * one, rtol=1e-6, atol=1e-7)
    pairs = hj.eigenpairs(field, 56, "dirichlet")
    inner = hj.varadhan_distance(pairs, times[:1], (4, 4))[0, 0]
    assert np.isnan(inner[0]).all()
    assert np.isfinite(inner[1:-1, 1:-1]).all()
    with pytest.raises(ValueError, match="sources: got a node on a Dirichlet boundary"):
        hj.varadhan_distance(pairs, times, (0, 4))


def test_distances_that_are_nan_are_told_with_their_cause():
    mask = np.ones((9, 9), bool)
    mask[:, 4] = False
    apart = hj.TensorField(hj.Grid((9, 9), mask=mask, components="all"), np.tile(np.eye(2), (9, 9, 1, 1)))
    pairs = hj.eigenpairs(apart, 72, solver="dense", multiplet="drop")
    with pytest.warns(hj.AccuracyWarning) as told:
        distance = hj.varadhan_distance(pairs, [40.0], (4, 1))[0, 0]
    assert [str(each.message).split(" of the")[0] for each in told] == ["sources: 50.0%"]
    assert np.isfinite(distance[:, :4]).all()
    assert np.isnan(distance[:, 4:]).all()
    with pytest.warns(hj.AccuracyWarning) as told:
        jax.grad(lambda t: jnp.nansum(hj.varadhan_distance(pairs, t, (4, 1))[..., :4]))(jnp.array([0.5]))
    assert [str(each.message).split(":")[0] for each in told] == ["sources", "times"]


# --- a tunnel ---------------------------------------------------------------------------------------------------------

SHAPE, WALL = (37, 27), slice(10, 17)


def halls(opening: int) -> hj.TensorField:
    """Two halls with a wall between them, joined at one end; and a tunnel through the wall, so many elements wide."""
    mask = np.ones(SHAPE, dtype=bool)
    mask[:30, WALL] = False
    if opening:
        mask[5 : 6 + opening, WALL] = True
    return hj.TensorField(hj.Grid(SHAPE, mask=mask), np.broadcast_to(np.eye(2), (*SHAPE, 2, 2)))


def shortest_way(field: hj.TensorField, start: tuple[int, int], end: tuple[int, int]) -> float:
    """The length of the shortest way along the sides and diagonals of elements: another notion than the kernel's."""
    inside, number = field.grid.inside, np.arange(np.prod(SHAPE)).reshape(SHAPE)
    rows, columns, lengths = [], [], []
    for step in ((0, 1), (1, 0), (1, 1), (1, -1)):
        here = np.argwhere(inside)
        there = here + step
        kept = ((there >= 0) & (there < SHAPE)).all(axis=1)
        here, there = here[kept], there[kept]
        kept = inside[tuple(there.T)]
        rows.append(number[tuple(here[kept].T)])
        columns.append(number[tuple(there[kept].T)])
        lengths.append(np.full(kept.sum(), np.hypot(*step)))
    entries = np.concatenate(lengths), (np.concatenate(rows), np.concatenate(columns))
    return dijkstra(coo_array(entries, (number.size,) * 2), directed=False, indices=number[start])[number[end]]


@pytest.mark.slow
def test_a_tunnel_changes_distances_but_hardly_the_signature():
    start, end, times = (5, 8), (5, 18), jnp.array([16.0, 64.0])
    without, thin, wide = (halls(width) for width in (0, 1, 12))
    far, near = (shortest_way(field, start, end) for field in (without, thin))
    assert far > 5 * near
    signatures = [
        np.asarray(hj.hks(hj.eigenpairs(f, 150), times))[:, without.grid.inside] for f in (without, thin, wide)
    ]
    scale = np.linalg.norm(signatures[0], axis=1)
    change, control = (np.linalg.norm(s - signatures[0], axis=1) / scale for s in signatures[1:])
    assert change.max() < 0.06
    assert (control > 3 * change).all()
