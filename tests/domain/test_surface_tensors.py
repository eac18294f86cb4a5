"""Tensor fields on surfaces against the same metric in a chart."""

from functools import partial
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from annotations import unchecked
from differences import directional

import hks_jax as hj
from hks_jax.domain import examples

TETRAHEDRON = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], dtype=float)
FACES = np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])


def square(n):
    """The grid of a unit square, and its triangulation: vertex i·n + j is node (i, j)."""
    grid = hj.Grid((n, n), 1 / (n - 1))
    i, j = (axis.ravel() for axis in np.indices((n - 1, n - 1)))
    a, b, c, d = ((i + p) * n + j + q for p, q in ((0, 0), (1, 0), (1, 1), (0, 1)))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return grid, np.pad(grid.nodes.reshape(-1, 2), [(0, 0), (0, 1)]), faces


def smooth(x, y):
    """Tensors in space, (…, 3, 3), whose third axis is no principal one."""
    zero = 0 * x
    return np.stack(
        [
            np.stack([1.5 + np.cos(3 * x), 0.4 * np.sin(2 * x + y), 0.3 + zero], axis=-1),
            np.stack([0.4 * np.sin(2 * x + y), 1.0 + 0.5 * y, 0.2 * y], axis=-1),
            np.stack([0.3 + zero, 0.2 * y, 2.0 + zero], axis=-1),
        ],
        axis=-2,
    )


def rotation(rng):
    q = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    return q * np.linalg.det(q)


@pytest.mark.parametrize("metric", ["tensor", "inverse", "adjugate"])
def test_the_identity_is_the_metric_of_space(metric):
    mesh = examples.bumpy_torus_mesh(6)
    identity = np.broadcast_to(np.eye(3), (len(mesh.faces), 3, 3))
    got = hj.SurfaceMesh.from_tensors(mesh.vertices, mesh.faces, identity, metric)
    np.testing.assert_allclose(got.metric, mesh.metric, rtol=1e-12, atol=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("metric", "at"),
    [
        ("inverse", "vertices"),
        ("tensor", "faces"),
        ("adjugate", "vertices"),
    ],
)
def test_a_planar_square_converges_to_the_grid(metric, at):
    times, differences = [0.2, 0.5], []
    for n in (10, 19):
        grid, vertices, faces = square(n)
        tensors = smooth(*np.moveaxis(grid.nodes, -1, 0))
        place = vertices if at == "vertices" else vertices[faces].mean(axis=1)
        mesh = hj.SurfaceMesh.from_tensors(vertices, faces, smooth(place[:, 0], place[:, 1]), metric)
        ours = hj.eigenpairs(mesh, 25)
        theirs = hj.eigenpairs(hj.TensorField.from_diffusion(grid, tensors[..., :2, :2], metric), 25)
        values = np.asarray(ours.eigenvalues)[1:8] / np.asarray(theirs.eigenvalues)[1:8] - 1
        signatures = np.reshape(hj.hks(ours, times), (-1, n, n)) / np.asarray(hj.hks(theirs, times)) - 1
        differences.append([np.abs(values).max(), np.sqrt(np.mean(signatures**2))])
    orders = np.log2(np.divide(*differences))
    assert (orders > 1.6).all(), (orders, differences)
    assert max(differences[1]) < 0.03


@pytest.mark.slow
def test_nothing_depends_on_how_the_surface_lies_in_space(rng):
    _, vertices, faces = square(5)
    vertices = vertices + 0.1 * rng.standard_normal(vertices.shape)
    tensors, turn = smooth(vertices[:, 0], vertices[:, 1]), rotation(rng)
    for metric, way in product(("tensor", "inverse", "adjugate"), ("linear", "log-euclidean")):
        plain = hj.SurfaceMesh.from_tensors(vertices, faces, tensors, metric, interpolation=way)
        moved = (vertices @ turn.T, faces, turn @ tensors @ turn.T, metric)
        turned = hj.SurfaceMesh.from_tensors(*moved, interpolation=way)
        np.testing.assert_allclose(turned.metric, plain.metric, rtol=1e-11, atol=1e-14)
    np.testing.assert_allclose(hj.eigenpairs(turned, 10).eigenvalues, hj.eigenpairs(plain, 10).eigenvalues, atol=1e-9)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:k = 8 cuts")
@pytest.mark.parametrize("metric", [pytest.param("tensor", marks=pytest.mark.slow), "inverse"])
def test_an_anisotropic_torus_converges_to_its_chart(metric):
    """Tensors that act in the surface alone: fast about the axis, slow about the tube, without an inverse in space."""
    embedding = partial(examples.torus, major=2.0, minor=1.0)
    fast, slow = 1.8, 0.6

    def lengths(u):
        return jnp.linalg.norm(jax.jacfwd(embedding)(u), axis=0)

    def chart(u):
        g = lengths(u) ** 2
        factors = jnp.array([fast, slow])
        return jnp.diag(g * factors if metric == "tensor" else g / factors)

    def tensor(u):
        frame = jax.jacfwd(embedding)(u) / lengths(u)
        return frame @ jnp.diag(jnp.array([fast, slow])) @ frame.T

    errors = []
    for n in (12, 24):
        grid = hj.Grid((n, n), 2 * np.pi / n)
        nodes = jnp.asarray(grid.nodes).reshape(-1, 2)
        mesh = hj.SurfaceMesh.from_tensors(
            jax.vmap(embedding)(nodes), examples.bumpy_torus_mesh(n).faces, jax.vmap(tensor)(nodes), metric
        )
        theirs = hj.eigenpairs(hj.TensorField.from_function(chart, grid), 8, "periodic").eigenvalues
        errors.append(np.abs(hj.eigenpairs(mesh, 8).eigenvalues[1:] / theirs[1:] - 1).max())
    assert np.log2(errors[0] / errors[1]) > 1.6
    assert errors[1] < 0.05


@pytest.mark.slow
@pytest.mark.parametrize(
    ("metric", "way"),
    [
        ("tensor", "linear"),
        ("inverse", "linear"),
        ("adjugate", "linear"),
        ("inverse", "log-euclidean"),
    ],
)
def test_gradient_with_respect_to_the_tensors(rng, metric, way):
    _, vertices, faces = square(5)
    vertices = vertices + 0.05 * rng.standard_normal(vertices.shape)
    tensors = jnp.asarray(smooth(vertices[:, 0], vertices[:, 1]))
    direction = jnp.asarray(rng.standard_normal(tensors.shape))
    direction = 0.1 * (direction + jnp.swapaxes(direction, -1, -2))

    def loss(tensors):
        mesh = hj.SurfaceMesh.from_tensors(vertices, faces, tensors, metric, interpolation=way)
        return jnp.sum(hj.hks(hj.eigenpairs(mesh, 25), jnp.array([0.3])) ** 2)

    gradient = jax.jit(jax.grad(loss))(tensors)
    assert jnp.vdot(gradient, direction) == pytest.approx(float(directional(loss, tensors, direction)), rel=1e-7)


def test_bad_tensors_are_refused():
    grid, vertices, faces = square(4)
    tensors = smooth(*np.moveaxis(grid.nodes.reshape(-1, 2), -1, 0))

    def refused(message, tensors=tensors, metric="tensor", **more):
        with unchecked(), pytest.raises(ValueError, match=message):
            hj.SurfaceMesh.from_tensors(vertices, faces, tensors, metric, **more)

    refused("metric: got None; expected .*There is no default", metric=None)
    refused(r"tensors: got shape \(5, 3, 3\); expected \(18, 3, 3\), one per face, or \(16, 3, 3\)", tensors[:5])
    refused(r"tensors: got shape \(16, 3, 3\); expected \(18, 3, 3\), one per face$", at="faces")
    refused(r'at: got "?\'?corners', at="corners")
    broken = tensors.copy()
    broken[5] = np.nan
    refused(r"tensors: 1 of 16 tensors are NaN or infinite \(the first at vertex \(5,\)\)", broken)
    broken[5] = tensors[5] + np.triu(np.ones((3, 3)), 1)
    refused("tensors: 1 of 16 tensors are unsymmetric", broken)
    broken[[5, 9]] = np.diag([1.0, -0.1, 1.0])
    refused(r"2 of 16 tensors are not positive definite on the faces around them \(the first at vertex 5\)", broken)
    broken[[5, 9]] = np.diag([0.0, 0.0, 1.0])
    refused("2 of 16 tensors are not positive definite", broken)
    normal = tensors.copy()
    normal[..., 2, 2] = -1.0  # what happens across the surface does not matter
    hj.SurfaceMesh.from_tensors(vertices, faces, normal, "inverse")


def test_traced_tensors_that_are_not_positive_definite_on_a_face_give_nan():
    """At a vertex too, whose share in the mean over a face may hide it."""
    grid, vertices, faces = square(4)
    tensors = jnp.asarray(smooth(*np.moveaxis(grid.nodes.reshape(-1, 2), -1, 0)))
    bad = tensors.at[5].set(-0.1 * jnp.eye(3))

    @jax.jit
    @jax.vmap
    @jax.value_and_grad
    def volume(tensors):
        return hj.assemble(hj.SurfaceMesh.from_tensors(vertices, faces, tensors, "adjugate")).volume

    @jax.jit
    @jax.vmap
    def area(metric):
        return hj.assemble(hj.SurfaceMesh(vertices, faces, metric)).volume

    values, gradients = volume(jnp.stack([tensors, bad]))
    np.testing.assert_array_equal(np.isfinite(values), [True, False])
    assert jnp.isfinite(gradients[0]).all()
    assert jnp.isnan(gradients[1, 5]).any()
    metric = hj.SurfaceMesh(vertices, faces).metric
    areas = area(jnp.stack([metric, metric.at[3].multiply(-1)]))
    np.testing.assert_allclose(areas, [1, np.nan], rtol=1e-14)


def test_as_many_faces_as_vertices_are_told_apart():
    tensors = np.broadcast_to(np.eye(3), (4, 3, 3)) * np.arange(1, 5)[:, None, None]
    with pytest.raises(ValueError, match="at: the mesh has as many faces as vertices, 4"):
        hj.SurfaceMesh.from_tensors(TETRAHEDRON, FACES, tensors, "tensor")
    plain = hj.SurfaceMesh(TETRAHEDRON, FACES).metric
    by_face = hj.SurfaceMesh.from_tensors(TETRAHEDRON, FACES, tensors, "tensor", at="faces").metric
    by_vertex = hj.SurfaceMesh.from_tensors(TETRAHEDRON, FACES, tensors, "tensor", at="vertices").metric
    np.testing.assert_allclose(by_face, np.arange(1.0, 5)[:, None, None] * plain)
    np.testing.assert_allclose(by_vertex, (1 + FACES.mean(axis=1))[:, None, None] * plain)
