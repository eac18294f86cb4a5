"""Meshes of tetrahedra: scikit-fem's assembly, exact spectra, grids, isometries, gradients, refusals."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import skfem
from annotations import unchecked
from differences import directional
from fields import random_spd
from forms import laplace_beltrami
from scipy.optimize import brentq
from scipy.spatial import Delaunay
from scipy.special import spherical_jn
from solids import box

import hks_jax as hj
from hks_jax.eigen.weyl import rim_measure

TETRAHEDRON = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
CELL = np.array([[0, 1, 2, 3]])


@pytest.fixture(scope="module")
def small():
    """A ball of 55 vertices, all of whose eigenpairs are cheap, off its symmetric place."""
    mesh = hj.examples.ball_mesh(2)
    noise = np.random.default_rng(5).standard_normal(mesh.vertices.shape)
    return np.asarray(mesh.vertices) + 0.05 * noise, mesh.cells


def smooth(x):
    """Tensors (…, 3, 3) that turn and stretch with the place."""
    a, b, c = np.moveaxis(x, -1, 0)
    zero = 0 * a
    rows = [
        [1.5 + np.cos(2 * a), 0.4 * np.sin(a + b), 0.2 * c],
        [0.4 * np.sin(a + b), 1.0 + 0.5 * b, zero],
        [0.2 * c, zero, 1.2 + 0.3 * a * c],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def test_agrees_with_scikit_fem(rng):
    """A random tensor on each cell, in the axes of space."""
    vertices, cells = box((3, 4, 3), (1.0, 2.0, 0.7))
    vertices = vertices + 0.05 * rng.standard_normal(vertices.shape)
    tensors = random_spd(rng, (len(cells), 1, 1), 0.4)[:, 0, 0]
    theirs = skfem.MeshTet(vertices.T, cells.T, sort_t=False)
    basis = skfem.Basis(theirs, skfem.ElementTetP1(), intorder=2)
    constants = basis.with_element(skfem.ElementTetP0())
    parts = {f"t{a}{b}": constants.interpolate(tensors[:, a, b]) for a in range(3) for b in range(3)}

    def metric(w):
        return np.stack([np.stack([np.asarray(w[f"t{a}{b}"]) for b in range(3)], -1) for a in range(3)], -2)

    pencil = hj.assemble(hj.TetMesh.from_tensors(vertices, cells, tensors, "tensor", at="cells"))
    for ours, form in zip((pencil.stiffness, pencil.mass), laplace_beltrami(metric), strict=True):
        expected = form.assemble(basis, **parts)
        assert abs(ours.to_scipy() - expected).max() <= 1e-12 * abs(expected).max()


def squares(lengths, first):
    """The lowest eigenvalues of a box whose eigenfunctions are products of (co)sines from the given number on."""
    terms = [(np.pi * np.arange(first, 12) / length) ** 2 for length in lengths]
    return np.sort((terms[0][:, None, None] + terms[1][:, None] + terms[2]).ravel())


@pytest.mark.slow
@pytest.mark.parametrize(("boundary", "first"), [("neumann", 0), ("dirichlet", 1)])
def test_box_converges_at_second_order(boundary, first):
    lengths, errors = (1.0, 1.2, 0.8), []
    for n in (5, 9):
        pairs = hj.eigenpairs(hj.TetMesh(*box((n,) * 3, lengths)), 7, boundary, solver="dense")
        exact = squares(lengths, first)[:7]
        errors.append(np.abs(pairs.eigenvalues[1 - first :] / exact[1 - first :] - 1).max())
    assert 1.8 < np.log2(errors[0] / errors[1]) < 2.5
    assert errors[1] < (0.08 if boundary == "neumann" else 0.25)


def bessel_squares(derivative):
    """The positive eigenvalues of the unit ball: squared zeros of jₗ or its derivative, 2l + 1 times each."""
    found = []
    for order in range(6):
        x = np.linspace(0.5, 12, 600)
        values = spherical_jn(order, x, derivative)
        for i in np.flatnonzero(values[1:] * values[:-1] < 0):
            zero = brentq(lambda y, order=order: spherical_jn(order, y, derivative), x[i], x[i + 1])
            found += [zero**2] * (2 * order + 1)
    return np.sort(found)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:k = ")
@pytest.mark.parametrize("boundary", ["neumann", "dirichlet"])
def test_ball_converges_at_second_order(boundary):
    natural, errors = boundary == "neumann", []
    for n in (3, 6):
        pairs = hj.eigenpairs(hj.examples.ball_mesh(n), 13 + natural, boundary, solver="dense")
        exact = bessel_squares(natural)[:13]
        errors.append(np.abs(pairs.eigenvalues[int(natural) :] / exact - 1).max())
    assert 1.6 < np.log2(errors[0] / errors[1]) < 2.5
    assert errors[1] < 0.15


@pytest.mark.slow
@pytest.mark.parametrize(
    ("metric", "at", "way"),
    [
        pytest.param("inverse", "vertices", "linear", marks=pytest.mark.slow),
        ("adjugate", "vertices", "log-euclidean"),
    ],
)
def test_agrees_with_a_grid_of_the_same_metric(metric, at, way):
    """Both converge at second order, and so does their difference."""
    times, differences = [0.15, 0.3], []
    for n in (5, 9):
        grid = hj.Grid((n,) * 3, 1 / (n - 1))
        mesh = hj.TetMesh.from_tensors(*box(grid.shape), smooth(grid.nodes.reshape(-1, 3)), metric, interpolation=way)
        field = hj.TensorField.from_diffusion(grid, smooth(grid.nodes), metric, interpolation=way)
        ours, theirs = (hj.eigenpairs(domain, 40, solver="dense") for domain in (mesh, field))
        values = ours.eigenvalues[1:6] / theirs.eigenvalues[1:6] - 1
        signatures = hj.hks(ours, times).reshape(-1, n, n, n) / hj.hks(theirs, times) - 1
        differences.append([float(jnp.abs(values).max()), float(jnp.sqrt(jnp.mean(signatures**2)))])
    orders = np.log2(np.divide(*differences))
    assert (orders > 1.5).all(), (orders, differences)
    assert max(differences[1]) < 0.05


@pytest.mark.parametrize("metric", ["tensor", "inverse", "adjugate"])
def test_the_identity_is_the_metric_of_space_and_readings_are_algebra(rng, small, metric):
    vertices, cells = small
    plain = hj.TetMesh(vertices, cells).metric
    got = hj.TetMesh.from_tensors(vertices, cells, np.broadcast_to(np.eye(3), (len(cells), 3, 3)), metric)
    np.testing.assert_allclose(got.metric, plain, rtol=1e-12, atol=1e-14)
    D = random_spd(rng, (len(cells), 1, 1), 0.4)[:, 0, 0]
    inverse = np.linalg.inv(D)
    g = {"tensor": D, "inverse": inverse, "adjugate": np.linalg.det(D)[:, None, None] * inverse}[metric]
    edges = np.swapaxes(vertices[cells[:, 1:]] - vertices[cells[:, :1]], 1, 2)
    expected = np.swapaxes(edges, 1, 2) @ g @ edges
    got = hj.TetMesh.from_tensors(vertices, cells, D, metric).metric
    np.testing.assert_allclose(got, expected, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(hj.TetMesh(vertices, cells, got).metric, got)


def test_isometries(rng, small):
    """A rigid motion changes nothing; a linear map of the vertices is the metric that it pulls back."""
    vertices, cells = small
    times = [1.0, 2.0]

    def signature(mesh):
        return hj.hks(hj.eigenpairs(mesh, len(vertices)), times)

    turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    turn *= np.linalg.det(turn)
    plain = signature(hj.TetMesh(vertices, cells))
    np.testing.assert_allclose(signature(hj.TetMesh(vertices @ turn.T + [1, -2, 3], cells)), plain, rtol=1e-10)
    shear = np.eye(3) + 0.3 * rng.standard_normal((3, 3))
    assert np.linalg.det(shear) > 0
    pulled = hj.TetMesh.from_tensors(vertices, cells, np.broadcast_to(shear.T @ shear, (len(cells), 3, 3)), "tensor")
    mapped = signature(hj.TetMesh(vertices @ shear.T, cells))
    np.testing.assert_allclose(signature(pulled), mapped, rtol=1e-10)
    assert np.abs(mapped / plain - 1).max() > 0.1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("at", "way", "k"),
    [
        pytest.param("cells", "linear", 55, marks=pytest.mark.slow),
        pytest.param("vertices", "log-euclidean", 20, marks=pytest.mark.slow),
        ("vertices", "linear", 20),
    ],
)
def test_gradients_with_respect_to_tensors_and_vertices(rng, small, at, way, k):
    vertices, cells = small
    place = vertices[cells].mean(axis=1) if at == "cells" else vertices
    weights = jnp.asarray(rng.standard_normal(len(vertices)))

    @jax.jit
    def loss(both):
        mesh = hj.TetMesh.from_tensors(both[0], cells, both[1], "inverse", at=at, interpolation=way)
        return jnp.sum(weights * hj.hks(hj.eigenpairs(mesh, k, solver="dense"), jnp.array([0.3]))[0])

    point = jnp.asarray(vertices), jnp.asarray(smooth(place))
    gradient = jax.jit(jax.grad(loss))(point)
    noise = [jnp.asarray(rng.standard_normal(leaf.shape)) for leaf in point]
    steps = (0.05 * noise[0], 0 * noise[1]), (0 * noise[0], 0.1 * (noise[1] + jnp.swapaxes(noise[1], 1, 2)))
    for step in steps:
        expected = directional(lambda s, step=step: loss(jax.tree.map(lambda p, q: p + s * q, point, step)), 0.0, 1.0)
        got = sum(jnp.vdot(g, s) for g, s in zip(gradient, step, strict=True))
        assert got == pytest.approx(float(expected), rel=1e-7)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:pairs. got 20; on average:hks_jax.AccuracyWarning")
def test_everything_that_takes_pairs_takes_these(small):
    mesh = hj.TetMesh(*small)
    pairs = hj.eigenpairs(mesh, 20)
    assert hj.wks(pairs).shape[-1] == len(mesh.vertices)
    assert jnp.isfinite(hj.biharmonic_distance(pairs, 0)).all()
    report = hj.truncation(pairs, [0.5, 1.0])
    assert (report.resolution_bias > 0).all()
    assert hj.truncation_map(pairs, [0.5]).shape == (1, len(mesh.vertices))
    following = float(pairs.next_eigenvalue)
    assert int(hj.count_eigenvalues(mesh, (float(pairs.eigenvalues[-1]) + following) / 2)) == 20


@pytest.mark.slow
def test_the_estimated_bias_is_that_of_a_box():
    """The median over the nodes, against the product of three theta functions, within the factor that it is safe by."""
    n, t = 9, 0.12
    mesh = hj.TetMesh(*box((n,) * 3))
    m = np.arange(100)
    modes = np.where(m == 0, 1, 2) * np.exp(-((np.pi * m) ** 2) * t)
    one = (modes * np.cos(np.pi * m * np.linspace(0, 1, n)[:, None]) ** 2).sum(axis=1)
    exact = (one[:, None, None] * one[:, None] * one).ravel()
    for mass in ("consistent", "lumped"):
        pairs = hj.eigenpairs(mesh, n**3, mass=mass, solver="dense")
        error = np.median(np.abs(hj.hks(pairs, [t])[0] / exact - 1))
        assert 0.8 < float(hj.truncation(pairs, [t]).resolution_bias[0]) / error < 12


def test_rims_and_weyl():
    lengths = (1.0, 2.0, 3.0)
    mesh = hj.TetMesh(*box((3, 4, 3), lengths))
    stretched = hj.TetMesh.from_tensors(
        mesh.vertices, mesh.cells, np.broadcast_to(np.diag([4.0, 1.0, 1.0]), (len(mesh.cells), 3, 3)), "tensor"
    )
    for boundary, sign in (("neumann", 1), ("dirichlet", -1)):
        pencil = hj.assemble(mesh, boundary)
        assert float(pencil.volume) == pytest.approx(6)
        assert rim_measure(mesh, pencil.space) == pytest.approx(sign * 22)
        law = 6 * 27 / (6 * np.pi**2) + sign * 22 * 9 / (16 * np.pi)
        np.testing.assert_allclose(hj.weyl_count(pencil, [9.0], mesh), [law])
    assert rim_measure(stretched, hj.assemble(stretched).space) == pytest.approx(2 * (6 + 2 * 3 + 2 * 2))


def test_the_boundary_is_closed_and_faces_outward(small):
    mesh = hj.TetMesh(*small)
    surface, numbers = mesh.boundary()
    np.testing.assert_array_equal(surface.vertices, mesh.vertices[numbers])
    np.testing.assert_array_equal(np.flatnonzero(mesh.triangulation.boundary_vertices), numbers)
    assert not surface.triangulation.boundary_vertices.any()
    # Gauss: the volume is the flux of x/3.
    enclosed = np.linalg.det(np.asarray(surface.vertices)[surface.faces]).sum() / 6
    assert enclosed == pytest.approx(float(hj.assemble(mesh).volume))


def test_a_mesh_in_pieces():
    two = hj.TetMesh(np.concatenate([TETRAHEDRON, TETRAHEDRON + 9]), np.concatenate([CELL, CELL + 4]))
    assert two.triangulation.labels[1] == 2
    np.testing.assert_array_equal(hj.eigenpairs(two, 2).eigenvalues, [0, 0])
    with pytest.raises(ValueError, match="every vertex is on the mesh's boundary"):
        hj.assemble(two, "dirichlet")


def test_bad_meshes_are_refused(rng):
    def refused(message, vertices=TETRAHEDRON, cells=CELL, *metric):
        with unchecked(), pytest.raises(ValueError, match=message):
            hj.TetMesh(vertices, cells, *metric)

    refused(r"vertices: got shape \(4, 2\); expected \(V, 3\)", TETRAHEDRON[:, :2])
    refused(r"cells: got shape \(1, 3\), dtype int64; expected integers of shape \(C, 4\)", cells=CELL[:, :3])
    refused(r"cells: got vertex indices 1 … 4; expected 0 … 3", cells=CELL + 1)
    refused(r"vertices: 1 of 5 belong to no cell \(the first is vertex 4\)", np.pad(TETRAHEDRON, [(0, 1), (0, 0)]))
    lost = TETRAHEDRON.copy()
    lost[2, 1] = np.nan
    refused(r"vertices: 1 are NaN or infinite \(the first is vertex 2\)", lost)
    refused("metric: got shape .* one per tetrahedron", TETRAHEDRON, CELL, np.eye(3))
    negative = -np.eye(3)[None]
    refused(r"metric: 1 of 1 tensors are not .*\(the first at cell \(0,\)\)", TETRAHEDRON, CELL, negative)

    vertices, cells = box((3, 3, 3))
    flat = vertices.copy()
    flat[:, 2] = 0
    refused(r"cells: 48 of 48 tetrahedra have no volume \(the first is cell 0\)", flat, cells)
    swapped = cells.copy()
    swapped[[7, 30]] = swapped[[7, 30]][:, [1, 0, 2, 3]]
    refused(r"cells: 2 of 48 tetrahedra are inverted \(the first is cell 7\)", vertices, swapped)
    folded = vertices.copy()
    folded[13] += [1.2, 0, 0]  # the vertex in the middle, beyond a side
    refused(r"cells: \d+ of 48 tetrahedra are inverted", folded, cells)
    corners = folded[cells]
    left = np.linalg.det(corners[:, 1:] - corners[:, :1]) < 0
    turned = np.where(left[:, None], cells[:, [1, 0, 2, 3]], cells)
    refused(r"cells: \d+ pairs of tetrahedra overlap, as they lie on one side", folded, turned)
    refused("cells: 4 pairs of tetrahedra overlap", TETRAHEDRON, np.concatenate([CELL, CELL]))

    # SciPy's tetrahedra come in either order, as the message says how to mend.
    points = rng.standard_normal((40, 3))
    cells = Delaunay(points).simplices
    corners = points[cells]
    inverted = np.linalg.det(corners[:, 1:] - corners[:, :1]) < 0
    refused(f"cells: {inverted.sum()} of {len(cells)} tetrahedra are inverted .* swap two vertices", points, cells)
    cells[inverted] = cells[inverted][:, [1, 0, 2, 3]]
    assert float(hj.assemble(hj.TetMesh(points, cells)).volume) > 0


def test_bad_tensors_are_refused(small):
    vertices, cells = small
    tensors = smooth(vertices)

    def refused(message, tensors, metric="tensor", **more):
        with unchecked(), pytest.raises(ValueError, match=message):
            hj.TetMesh.from_tensors(vertices, cells, tensors, metric, **more)

    refused("metric: got None; expected .*There is no default", tensors, None)
    refused(r"expected \(160, 3, 3\), one per cell, or \(55, 3, 3\), one per vertex", tensors[:5])
    refused('at: got \'faces\'; expected "cells", "vertices" or None', tensors, at="faces")
    for change, what in ((np.nan, "NaN or infinite"), (np.triu(np.ones((3, 3)), 1), "unsymmetric")):
        broken = tensors.copy()
        broken[5] += change
        refused(rf"tensors: 1 of 55 tensors are {what} \(the first at vertex \(5,\)\)", broken)
    broken[[5, 9]] = np.diag([1.0, -0.1, 1.0])
    refused(r"tensors: 2 of 55 tensors are not positive definite, worst eigenvalue -0\.1 \(the first at vertex", broken)
    ball = hj.examples.ball_mesh(1)
    half = ball.cells[7:]
    with pytest.raises(ValueError, match="at: the mesh has as many cells as vertices, 13"):
        hj.TetMesh.from_tensors(ball.vertices, half, np.broadcast_to(np.eye(3), (13, 3, 3)), "tensor")


def test_traced_tetrahedra_and_tensors_that_are_wrong_give_nan(small):
    vertices, cells = map(np.asarray, small)
    tensors = jnp.asarray(smooth(vertices))

    @jax.jit
    @jax.vmap
    def volume(vertices, tensors):
        return hj.assemble(hj.TetMesh.from_tensors(vertices, cells, tensors, "adjugate")).volume

    plain = jax.jit(jax.vmap(lambda v: hj.assemble(hj.TetMesh(v, cells)).volume))
    inverted = vertices.copy()
    inverted[0] += 2.0
    bad = tensors.at[5].set(-0.1 * jnp.eye(3))
    both = jnp.stack([jnp.asarray(vertices), jnp.asarray(vertices), jnp.asarray(inverted)])
    values = volume(both, jnp.stack([tensors, bad, tensors]))
    np.testing.assert_array_equal(np.isfinite(values), [True, False, False])
    np.testing.assert_array_equal(np.isfinite(plain(both)), [True, True, False])


def test_float32_stays_float32(small):
    vertices, cells = small
    mesh = hj.TetMesh(vertices.astype(np.float32), cells)
    signature = hj.hks(hj.eigenpairs(mesh, 20), jnp.array([0.4], jnp.float32))
    assert signature.dtype == jnp.float32
    exact = hj.hks(hj.eigenpairs(hj.TetMesh(vertices, cells), 20), [0.4])
    np.testing.assert_allclose(signature, exact, rtol=2e-4)
