"""The mean of the Neumann and the Dirichlet signature, against what is known in closed form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fields import flat, random_spd
from scipy.spatial import Delaunay

import hks_jax as hj
from hks_jax.eigen import all_pencils
from hks_jax.eigen.one_pencil import pairs_of_pencil
from hks_jax.fem.boundary import doubled_problems, normalise_boundary

RIM_COEFFICIENT = np.sqrt(np.pi) / 4
"""4πt·HKS is 1 + this times κ√t on a rim of curvature κ."""


def masked_field(rng, shape=(7, 8)) -> hj.TensorField:
    mask = np.ones(shape, bool)
    mask[:3, :2] = False
    return hj.TensorField(hj.Grid(shape, 0.3, mask=mask), random_spd(rng, shape, 0.5))


def flat_disc(n: int) -> hj.SurfaceMesh:
    """The unit disc, n rings of triangles."""
    rings = [np.exp(2j * np.pi * np.arange(max(6 * i, 1)) / max(6 * i, 1)) * i / n for i in range(n + 1)]
    z = np.concatenate(rings)
    points = np.stack([z.real, z.imag], axis=-1)
    faces = Delaunay(points).simplices
    a, b, c = np.moveaxis(points[faces], 1, 0)
    area = np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    return hj.SurfaceMesh(np.pad(points, ((0, 0), (0, 1))), faces[area > 1e-9])


def all_pairs(domain, boundary, mass="consistent"):
    pencil = hj.assemble(domain, boundary, mass)
    return hj.eigenpairs(pencil, sum(part.space.n_dof for part in pencil.parts))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shape", "mass", "boundaries"),
    [
        ((7, 8), "consistent", ("mean", "neumann", "dirichlet-rim")),
        pytest.param((7, 8), "lumped", ("mean", "neumann", "dirichlet-rim"), marks=pytest.mark.slow),
        pytest.param((4, 5, 4), "consistent", ("mean", "neumann", "dirichlet-rim"), marks=pytest.mark.slow),
        # One axis stays periodic; the mask's rim goes with the mean.
        pytest.param(
            (7, 8),
            "consistent",
            (("mean", "periodic"), ("neumann", "periodic"), ("dirichlet", "periodic", "dirichlet")),
            marks=pytest.mark.slow,
        ),
        # The mask's rim alone.
        pytest.param(
            (7, 8),
            "consistent",
            (("neumann", "dirichlet", "mean"), ("neumann", "dirichlet"), ("neumann", "dirichlet", "dirichlet")),
            marks=pytest.mark.slow,
        ),
    ],
)
def test_the_mean_holds_the_pairs_of_both_problems(rng, shape, mass, boundaries):
    field, times = masked_field(rng, shape), [0.3, 0.8, 2.0]
    mean, natural, zero = (all_pairs(field, boundary, mass) for boundary in boundaries)
    n, d = hj.hks(natural, times), hj.hks(zero, times)
    np.testing.assert_allclose(hj.hks(mean, times), (n + d) / 2, rtol=1e-10)
    union = np.sort(np.concatenate([natural.eigenvalues, zero.eigenvalues]))
    np.testing.assert_allclose(mean.eigenvalues, union, rtol=1e-10, atol=1e-9)
    influence = np.asarray(hj.boundary_influence(mean, times))
    if "mean" in boundaries[0][:-1] or boundaries[0] == "mean":
        np.testing.assert_allclose(influence, np.clip((n - d) / (n + d), 0, 1), atol=1e-9)
    else:  # the sides have one condition, so that the influence of the whole boundary is estimated
        np.testing.assert_array_equal(influence[:, mean.space.domain & (np.indices(shape)[0] % (shape[0] - 1) == 0)], 1)


@pytest.mark.slow
def test_the_mean_without_a_spectrum(rng):
    field, times = masked_field(rng), [0.05, 0.3]
    expected = hj.hks(all_pairs(field, "mean"), times)
    for method in ("colouring", "selected-inversion"):
        found = hj.hks_spectrum_free(field, times, "mean", method=method, tolerance=1e-6)
        np.testing.assert_allclose(found, expected, rtol=1e-4)


def test_a_straight_rim_of_a_flat_metric_leaves_no_trace():
    """The rim of a mask, and the side of a grid: two copies glued along both make a flat torus."""
    grid = hj.Grid((14, 12), 0.1, mask=np.arange(14)[:, None] < 11 + np.zeros(12))
    field = hj.TensorField(grid, np.broadcast_to(np.eye(2), (14, 12, 2, 2)))
    mean = all_pairs(field, ("mean", "periodic"))
    values = np.asarray(hj.hks(mean, [0.01, 0.05]))[:, :11]
    np.testing.assert_allclose(values, values[:, :1, :1] * np.ones_like(values), rtol=1e-11)
    assert float(mean.pencil.volume) == pytest.approx(2 * 1.0 * 1.2)
    np.testing.assert_allclose(hj.weyl_count(mean, [50.0], field), hj.weyl_count(mean, [50.0]))


@pytest.mark.slow
def test_mirrors_and_the_rim_of_a_mask_together():
    """Half a square: mirrored sides undo the corners where the rim meets them."""
    grid = hj.Grid((9, 7), 0.1, mask=np.arange(9)[:, None] < 6 + np.zeros(7))
    field = hj.TensorField(grid, np.broadcast_to(np.eye(2), (9, 7, 2, 2)))
    pairs = all_pairs(field, (("neumann", "neumann"), "mirror", "neumann"))
    assert np.nanmax(hj.hks(pairs, [0.02], "flat")) > 1.9
    pairs = all_pairs(field, ("mirror", "mirror", "mean"))
    assert len(pairs.pencil.parts) == 8
    assert np.ptp(np.asarray(hj.hks(pairs, [0.02]))[0, :6]) < 1e-10


def test_on_a_curved_rim_curvature_is_left_to_first_order_in_the_root_of_t():
    mesh = flat_disc(16)
    rim = mesh.triangulation.boundary_vertices
    pairs = hj.eigenpairs(mesh, 200, "mean", "dense", multiplet="drop")
    roots = np.array([0.12, 0.24])
    values = np.asarray(hj.hks(pairs, roots**2, "flat"))
    excess = (values[:, rim].mean(axis=1) - 1) / roots
    assert 2 * excess[0] - excess[1] == pytest.approx(RIM_COEFFICIENT, rel=0.05)
    influence = np.asarray(hj.boundary_influence(pairs, roots**2))
    np.testing.assert_allclose((values * (1 + influence))[:, rim], 2 * values[:, rim], rtol=1e-6)
    assert np.abs(values[0] - 1).max() < 0.1 * np.abs(values * (1 + influence) - 1)[0].max()


@pytest.mark.slow
def test_on_a_geodesic_rim_the_expansion_holds_up_to_the_rim():
    """A zone of the unit sphere: the equator is the rim of a mask; two halves glued along it are the sphere itself."""
    shape, spacing = (24, 20), (0.05, 0.09)
    grid = hj.Grid(shape, spacing, (-0.1, 0.0), mask=np.arange(24)[:, None] >= 2 + np.zeros(20))
    field = hj.TensorField.from_function(lambda u: jnp.diag(jnp.stack([1.0, jnp.cos(u[0]) ** 2])), grid)
    times = [0.06, 0.12]
    pairs = hj.eigenpairs(field, 250, ("mean", "periodic"), "dense", multiplet="drop")
    values = np.asarray(hj.hks(pairs, times, "flat"))
    expansion = 4 * np.pi * np.array(times)[:, None, None] * hj.hks_expansion(field, times)
    np.testing.assert_allclose(expansion[1, 2:10], 1 + 0.04 + 0.12**2 / 15, rtol=1e-3)
    assert np.abs(values - expansion)[:, 2:8].max() < 0.007
    natural = values * (1 + np.asarray(hj.boundary_influence(pairs, times)))
    assert np.abs(natural - expansion)[:, 2].min() > 0.9


@pytest.mark.slow
@pytest.mark.parametrize("what", ["hks", pytest.param("influence", marks=pytest.mark.slow)])
def test_gradients_against_central_differences(rng, what):
    field = masked_field(rng, (6, 5))
    domain = hj.assemble(field).space.domain
    direction = random_spd(rng, (6, 5)) - np.eye(2)
    weights = np.where(domain, rng.standard_normal((6, 5)), 0)

    @jax.jit
    @jax.value_and_grad
    def mean(t):
        pairs = hj.eigenpairs(hj.TensorField(field.grid, t), 14, "mean")
        values = hj.hks(pairs, [0.1]) if what == "hks" else hj.boundary_influence(pairs, [0.1])
        return jnp.sum(jnp.where(domain, values[0], 0) * weights)

    gradient = mean(field.tensors)[1]
    ends = [float(mean(field.tensors + h * direction)[0]) for h in (1e-4, -1e-4, 2e-4, -2e-4)]
    difference = (8 * (ends[0] - ends[1]) - (ends[2] - ends[3])) / 12e-4
    assert float(jnp.sum(gradient * direction)) == pytest.approx(difference, rel=1e-6)


@pytest.mark.slow
def test_gradients_by_vertices(rng):
    mesh = flat_disc(4)
    direction = rng.standard_normal(mesh.vertices.shape)

    @jax.jit
    @jax.value_and_grad
    def mean(vertices):
        pairs = hj.eigenpairs(hj.SurfaceMesh(vertices, mesh.triangulation.cells), 30, "mean", multiplet="drop")
        return jnp.sum(hj.hks(pairs, [0.1])[0] ** 2)

    start = mesh.vertices + 0.02 * rng.standard_normal(mesh.vertices.shape)
    gradient = mean(start)[1]
    ends = [float(mean(start + h * direction)[0]) for h in (1e-5, -1e-5)]
    assert float(jnp.sum(gradient * direction)) == pytest.approx((ends[0] - ends[1]) / 2e-5, rel=1e-6)


@pytest.mark.slow
def test_a_solid_with_the_mean():
    """On the ball of radius 1 the sum of the principal curvatures is 2."""
    mesh = hj.examples.ball_mesh(9)
    pairs = hj.eigenpairs(mesh, 300, "mean", "dense", multiplet="drop")
    rim = mesh.triangulation.boundary_vertices
    times = np.array([0.06, 0.12])
    lacking = hj.truncation(pairs, times).resolution_bias  # 1 and 2 %, as large as the second order
    values = np.asarray(hj.hks(pairs, times, "flat"))[:, rim].mean(axis=1) * (1 + lacking)
    excess = (values - 1) / np.sqrt(times)
    extrapolated = excess[0] - (excess[1] - excess[0]) / (np.sqrt(2) - 1)
    assert extrapolated == pytest.approx(2 * RIM_COEFFICIENT, rel=0.1)


@pytest.mark.slow
def test_a_metric_is_fitted_to_the_mean(rng):
    field = masked_field(rng)
    grid, domain = field.grid, hj.assemble(field).space.domain
    x, y = np.moveaxis(np.asarray(grid.nodes), -1, 0)
    hidden = hj.TensorField(grid, np.exp(0.3 * np.sin(x) * np.cos(y))[..., None, None] * np.eye(2))
    times = [0.3, 0.6, 1.2]
    target = hj.hks(all_pairs(hidden, "mean"), times)
    start = hj.TensorField(grid, np.broadcast_to(np.eye(2), (*grid.shape, 2, 2)))
    found = hj.fit_metric(start, target, times, "conformal", boundary="mean", search=hj.inverse.Search(max_steps=20))
    got = hj.hks(all_pairs(found.field, "mean"), times)
    assert np.abs(np.log(got / target))[:, domain].max() < 0.01


def test_bad_boundaries_are_named(rng):
    field = masked_field(rng)
    with pytest.raises(ValueError, match=r"got \('mean', 'periodic'\) for one axis"):
        hj.assemble(field, (("mean", "periodic"), "neumann"))
    with pytest.raises(ValueError, match="got 'periodic' for the rim of a mask; expected one of 'neumann'"):
        hj.assemble(field, ("periodic", "periodic", "periodic"))
    with pytest.raises(ValueError, match='"mean", but the domain has no rim'):
        hj.assemble(flat((5, 5), (1.0, 1.0)), ("periodic", "periodic", "mean"))
    with pytest.raises(ValueError, match='"mean", but the domain has no rim'):
        hj.assemble(hj.examples.sphere_mesh(2), "mean")
    thin = hj.TensorField(hj.Grid((2, 9), mask=np.ones((2, 9), bool)), np.broadcast_to(np.eye(2), (2, 9, 2, 2)))
    for boundary in ("mean", "mirror", ("mirror", "periodic")):
        with pytest.raises(ValueError, match=r'all nodes .* on its rim or sides; .* inner nodes\. Pass "neumann"'):
            hj.assemble(thin, boundary)
    with pytest.raises(ValueError, match="every node of the domain is on a Dirichlet side or rim"):
        hj.assemble(thin, ("dirichlet", "neumann", "mean"))
    triangle = hj.SurfaceMesh(np.eye(3), [[0, 1, 2]])
    with pytest.raises(ValueError, match=r'all nodes .* on its rim or sides; .* inner nodes\. Pass "neumann"'):
        hj.assemble(triangle, "mean")
    with pytest.raises(ValueError, match="k: got None"):
        hj.boundary_influence(field, [1.0])
    with pytest.warns(hj.AccuracyWarning, match="acts nowhere: there is no mask"):
        hj.assemble(flat((5, 5), (1.0, 1.0)), ("neumann", "neumann", "dirichlet"))


@pytest.mark.parametrize(
    ("shape", "lengths"),
    [
        ((14, 12, 6), (2.0, 1.7, 0.8)),  # the even problem has 88 of the 120 lowest eigenvalues
        pytest.param((9, 9, 9), (1.0, 1.0, 1.0), marks=pytest.mark.slow),
        pytest.param((34, 9), (4.0, 1.0), marks=pytest.mark.slow),
    ],
)
def test_each_problem_of_a_doubled_domain_is_solved_once(shape, lengths, monkeypatch):
    """The shares follow Weyl's law with its boundary term, which grows like k^(2/3) in 3D and like √k in 2D."""
    sizes = []

    def counting(pencil, solver, k, *more):
        sizes.append(k)
        return pairs_of_pencil(pencil, solver, k, *more)

    monkeypatch.setattr(all_pencils, "pairs_of_pencil", counting)
    pairs = hj.eigenpairs(flat(shape, lengths), 120, "mean", "shift-invert", multiplet="drop")
    assert len(sizes) == 2
    assert [each.k for each in pairs.problems] == sizes
    assert sum(int(each.kept.sum()) for each in pairs.problems) == int(pairs.kept.sum())


@pytest.mark.slow
@pytest.mark.parametrize("boundary", ["mean", "mirror", ("mirror", "mean")])
def test_a_part_that_others_include_has_no_more_than_its_share_of_pairs(boundary, rng):
    field = hj.TensorField(hj.Grid((9, 8), 0.1), random_spd(rng, (9, 8)))
    pairs = hj.eigenpairs(field, 60, boundary)
    counts = np.array([each.kept.sum() for each in pairs.problems])
    shares = [60 // len(including) for including in pairs.pencil.including]
    assert (counts <= shares).all()
    assert sorted(map(len, pairs.pencil.including)) == ([1, 2] if len(shares) == 2 else [1, 2, 2, 4])
    traced = jax.jit(lambda t: hj.eigenpairs(hj.TensorField(field.grid, t), 60, boundary).eigenvalues)(field.tensors)
    np.testing.assert_allclose(traced, pairs.eigenvalues, atol=1e-9 * pairs.eigenvalues[-1])


def test_pairs_that_are_shapes_or_tangents(rng):
    tensors = jnp.asarray(random_spd(rng, (5, 6)))

    def pairs(tensors):
        return hj.eigenpairs(hj.TensorField(hj.Grid((5, 6), 0.25), tensors), 6, "mean")

    shapes = jax.eval_shape(pairs, tensors)
    assert (shapes.eigenvalues.shape, shapes.vectors.shape, shapes.next_eigenvalue.shape) == ((6,), (6, 30), ())
    assert "k=6" in repr(shapes)
    tangent = jax.jvp(pairs, (tensors,), (tensors,))[1]
    both = pairs(tensors), pairs(2 * tensors)
    for wrong in (tangent, jax.tree.map(lambda a, b: a - b if a.dtype.kind != "b" else a, *both)):
        with pytest.raises(ValueError, match="does not know the order of the eigenvalues"):
            _ = wrong.eigenvalues
    change = jax.jvp(lambda x: pairs(x).eigenvalues, (tensors,), (tensors,))[1]  # λ of the metric cT is λ/c
    np.testing.assert_allclose(change, -both[0].eigenvalues, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("shape", [(9, 8), (6, 5, 7)])
def test_problems_that_are_integrated_together_are_those_assembled_alone(rng, shape):
    field = masked_field(rng, shape)
    together = hj.assemble(field, "mean").parts
    compiled = jax.jit(lambda T: hj.assemble(field.with_tensors(T), "mean"))(field.tensors).parts  # by XLA, not NumPy
    problems = doubled_problems(normalise_boundary("mean", len(shape)))
    assert len(together) == len(problems) == 2
    for boundary, *pair in zip(problems, together, compiled, strict=True):
        alone = hj.assemble(field, boundary)
        for each in pair:
            for name in ("stiffness", "mass"):
                one, other = (np.asarray(getattr(pencil, name).to_dense()) for pencil in (each, alone))
                np.testing.assert_allclose(one, other, rtol=1e-11, atol=1e-13)
            np.testing.assert_allclose(each.volume, alone.volume, rtol=1e-12)
