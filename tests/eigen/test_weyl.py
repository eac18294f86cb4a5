"""Weyl's law, and the boundary's influence, against what is known in closed form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fields import flat, random_spd

import hks_jax as hj
from hks_jax.eigen.weyl import rim_measure
from hks_jax.fem.boundary import normalise_boundary
from hks_jax.fem.space import grid_space


def rim(field, boundary):
    return rim_measure(field, grid_space(field.grid, normalise_boundary(boundary, field.grid.dimension)))


def test_rims_are_measured_in_the_metric_and_signed():
    field = flat((5, 9), (1.0, 2.0))
    assert rim(field, "neumann") == pytest.approx(6)
    assert rim(field, "dirichlet") == pytest.approx(-6)
    assert rim(field, (("neumann", "dirichlet"), "neumann")) == pytest.approx(2)
    assert rim(field, ("periodic", "neumann")) == pytest.approx(2 * 1.25)  # the period is 5·h
    assert rim(field, "periodic") == 0
    assert rim(hj.TensorField(field.grid, np.diag([9.0, 4.0]) * np.ones((5, 9, 1, 1))), "neumann") == pytest.approx(14)
    box = flat((4, 3, 5), (1.0, 2.0, 3.0))
    assert rim(box, "neumann") == pytest.approx(22)
    assert rim(box, (("dirichlet", "neumann"), "neumann", "neumann")) == pytest.approx(10)
    stretched = hj.TensorField(box.grid, np.diag([4.0, 1.0, 1.0]) * np.ones((4, 3, 5, 1, 1)))
    assert rim(stretched, "neumann") == pytest.approx(2 * (6 + 2 * 3 + 2 * 2))
    # a mask's rim is the outline of its elements, natural whatever the sides are
    mask = np.ones((5, 9), bool)
    mask[2, 4] = False  # a hole of 2 × 2 elements
    masked = hj.TensorField(hj.Grid((5, 9), 0.25, mask=mask), field.tensors)
    assert rim(masked, "neumann") == pytest.approx(6 + 2)
    assert rim(masked, "dirichlet") == pytest.approx(-6 + 2)


@pytest.mark.parametrize(
    ("boundary", "shift"),
    [("neumann", 0.25), ("dirichlet", 0.25), ("periodic", 0.0), (("neumann", "dirichlet"), -0.25)],
)
def test_the_law_counts_the_eigenvalues_of_rectangles(boundary, shift):
    """The mean of N(λ) less the law is the third term: ¼ of four like corners, −¼ of four unlike ones, 0 of a torus."""
    field = flat((5, 6), (1.0, 1.3))
    pencil = hj.assemble(field, boundary)
    below = np.linspace(0, 4000, 20000)
    count = np.searchsorted(exact_eigenvalues(boundary, (1.0, 1.3), field.grid), below)
    assert np.mean(count - hj.weyl_count(pencil, below, field)) == pytest.approx(shift, abs=0.15)
    first = hj.weyl_count(pencil, below)
    np.testing.assert_allclose(first, float(pencil.volume) * below / (4 * np.pi))
    if boundary in ("neumann", "dirichlet"):
        assert abs(np.mean(count - first)) > 5


def exact_eigenvalues(boundary, lengths, grid):
    kinds = (boundary,) * 2 if isinstance(boundary, str) else boundary
    terms = []
    for kind, length, n in zip(kinds, lengths, grid.shape, strict=True):
        m = np.arange(200.0)
        period = length * n / (n - 1)
        squares = {"neumann": m / length, "dirichlet": (m + 1) / length, "periodic": 2 * ((m + 1) // 2) / period}
        terms.append((np.pi * squares[kind]) ** 2)
    return np.sort((terms[0][:, None] + terms[1]).ravel())


def test_mirrors_have_no_rim_and_meshes_have_theirs():
    field = flat((5, 6), (1.0, 0.8))
    mirrored = hj.assemble(field, "mirror")
    np.testing.assert_allclose(hj.weyl_count(mirrored, [100.0], field), [4 * 0.8 * 100 / (4 * np.pi)])
    vertices = np.array([[0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0], [1, 0.5, 0.0]])
    faces = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    mesh = hj.SurfaceMesh(vertices, faces)
    for boundary, sign in (("neumann", 1), ("dirichlet", -1)):
        pencil = hj.assemble(mesh, boundary)
        np.testing.assert_allclose(
            hj.weyl_count(pencil, [9.0], mesh), [(2 * 9 + sign * 6 * 3) / (4 * np.pi)], atol=1e-12
        )


def test_weyl_in_three_dimensions():
    field = flat((5, 5, 5), (1.0, 1.0, 1.0))
    pencil = hj.assemble(field)
    np.testing.assert_allclose(hj.weyl_count(pencil, [400.0], field), [8000 / (6 * np.pi**2) + 6 * 400 / (16 * np.pi)])
    with pytest.raises(ValueError, match=r"domain: got shape \(3, 3\); expected the problem.s shape \(5, 5, 5\)"):
        hj.weyl_count(pencil, [1.0], flat((3, 3), (1.0, 1.0)))
    with pytest.raises(ValueError, match="values: got -1"):
        hj.weyl_count(pencil, [-1.0])


# --- the boundary's influence -------------------------------------------------------------------------------


@pytest.mark.slow
def test_at_straight_sides_it_is_exp_of_minus_squared_distance_over_t():
    """A strip, periodic in the other direction, which cancels; one of its sides is a mask's rim."""
    grid = hj.Grid.from_bounds(0.0, (1.1, 0.2), (34, 5), mask=np.arange(34)[:, None] < 31 + np.zeros(5))
    field = hj.TensorField(grid, np.broadcast_to(np.eye(2), (34, 5, 2, 2)))
    times = np.array([0.01, 0.02])
    influence = np.asarray(hj.boundary_influence(field, times, 100, ("neumann", "periodic")))
    distance = np.minimum(grid.axes[0], 1 - grid.axes[0])[:31]
    expected = np.exp(-(distance**2) / times[:, None])[..., None] * np.ones((1, 1, 5))
    near = distance < 0.3  # further in, the two sides add up
    assert np.abs(influence[:, :31] - expected)[:, near].max() < 0.02
    np.testing.assert_array_equal(influence[:, [0, 30]], 1)
    assert np.isnan(influence[:, 31:]).all()


def test_all_of_a_masks_rim_is_pinned_and_nothing_else():
    mask = np.ones((7, 9), bool)
    mask[:2, 6:] = mask[4, 4] = False
    field = hj.TensorField(hj.Grid((7, 9), mask=mask), np.broadcast_to(np.eye(2), (7, 9, 2, 2)))
    free = np.zeros((7, 9), bool)
    free[1:6, 1:8] = True
    free[:3, 5:] = free[3:6, 3:6] = False
    np.testing.assert_array_equal(hj.assemble(field, "dirichlet-rim").space.free, free)


@pytest.mark.slow
def test_influence_is_differentiable(rng):
    mask = np.ones((6, 5), bool)
    mask[:2, :2] = False
    grid = hj.Grid((6, 5), 0.2, mask=mask)
    tensors = random_spd(rng, (6, 5), 0.4)
    direction = random_spd(rng, (6, 5)) - np.eye(2)
    weights = np.where(mask, rng.standard_normal((6, 5)), 0)

    @jax.jit
    @jax.value_and_grad
    def mean(t):
        influence = hj.boundary_influence(hj.TensorField(grid, t), [0.2], 6, solver="dense")
        return jnp.sum(jnp.where(mask, influence[0], 0) * weights)

    gradient = mean(tensors)[1]
    ends = [float(mean(tensors + h * direction)[0]) for h in (1e-4, -1e-4, 2e-4, -2e-4)]
    difference = (8 * (ends[0] - ends[1]) - (ends[2] - ends[3])) / 12e-4
    assert float(jnp.sum(gradient * direction)) == pytest.approx(difference, rel=1e-6)


def test_influence_errors():
    field = flat((9, 9), (1.0, 1.0))
    with pytest.raises(ValueError, match='boundary: got \'dirichlet\'; expected "neumann" or "periodic"'):
        hj.boundary_influence(field, [0.1], 10, "dirichlet")
    with pytest.raises(ValueError, match="no rim"):
        hj.boundary_influence(field, [0.1], 10, "periodic")


@pytest.mark.filterwarnings("ignore:boundary.*which the mask does not reach")
@pytest.mark.parametrize("boundary", ["dirichlet", "mean"])
def test_a_rim_on_the_seam_of_a_periodic_axis_counts_like_any_other(boundary):
    band = np.zeros((16, 16), bool)
    band[4:12] = True
    counts = []
    for shift in (0, -4):  # an isometry
        grid = hj.Grid((16, 16), mask=np.roll(band, shift, 0), components="all")
        field = hj.TensorField(grid, np.tile(np.eye(2), (16, 16, 1, 1)))
        counts.append(hj.weyl_count(hj.assemble(field, ("periodic", "periodic", boundary)), [1.0], field))
    np.testing.assert_allclose(counts[1], counts[0], rtol=1e-12)
