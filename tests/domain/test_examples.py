import jax
import jax.numpy as jnp
import numpy as np
import pytest
from annotations import unchecked

import hks_jax as hj
from hks_jax.domain import examples
from hks_jax.domain.examples import phantom


@pytest.mark.slow
def test_bumpy_torus_mesh_and_field_are_one_surface():
    mesh, field = examples.bumpy_torus_mesh(160), examples.bumpy_torus_field(160)
    inner, outer = hj.assemble(mesh).volume, hj.assemble(field, "periodic").volume
    assert inner == pytest.approx(float(outer), rel=0.02)
    assert not mesh.triangulation.boundary_vertices.any()
    position = jax.vmap(examples.bumpy_torus)(jnp.asarray(field.grid.nodes).reshape(-1, 2))
    np.testing.assert_allclose(mesh.vertices, position)


def test_the_sphere_and_the_ball_are_round_closed_and_have_good_cells():
    sphere, ball = examples.sphere_mesh(6), examples.ball_mesh(6)
    assert (len(sphere.vertices), len(sphere.faces)) == (362, 720)
    assert (len(ball.vertices), len(ball.cells)) == (1 + 910 + 12, 20 * 6**3)
    np.testing.assert_allclose(np.linalg.norm(sphere.vertices, axis=1), 1)
    assert not sphere.triangulation.boundary_vertices.any()
    corners = np.asarray(sphere.vertices)[sphere.faces]
    assert (np.linalg.det(corners) > 0).all()
    surface, numbers = ball.boundary()
    layers = np.linalg.norm(ball.vertices, axis=1) * 6
    np.testing.assert_allclose(np.bincount(np.rint(layers).astype(int)), [1] + [10 * j * j + 2 for j in range(1, 7)])
    np.testing.assert_allclose(layers, np.rint(layers), atol=1e-12)
    np.testing.assert_allclose(layers[numbers], 6)
    assert len(surface.faces) == len(sphere.faces)
    # Volume over the cube of the root mean square edge, 1 for regular cells (Knupp's mean ratio is its 2/3rd power).
    for mesh, regular in ((sphere, np.sqrt(3) / 2), (ball, np.sqrt(0.5))):
        c = np.asarray(mesh.vertices)[mesh.triangulation.cells]
        d = c.shape[1] - 1
        pairs = [(i, j) for i in range(d + 1) for j in range(i)]
        edges = np.sqrt(np.mean([np.sum((c[:, i] - c[:, j]) ** 2, axis=1) for i, j in pairs], axis=0))
        steps = c[:, 1:] - c[:, :1]
        content = np.sqrt(np.linalg.det(steps @ np.swapaxes(steps, 1, 2)))
        assert (content / edges**d / regular).min() > 0.5
    with unchecked(), pytest.raises(ValueError, match="n: got 0"):
        examples.ball_mesh(0)


def test_pullback_is_the_first_fundamental_form():
    metric = examples.pullback(lambda x: jnp.stack([x[0], x[1], x[0] ** 2 + x[0] * x[1]]))
    a, b = 2 * 0.3 + 0.7, 0.3
    np.testing.assert_allclose(metric(jnp.array([0.3, 0.7])), [[1 + a * a, a * b], [a * b, 1 + b * b]])


def test_figure3_fields_are_the_papers():
    fields = examples.figure3_fields(11)
    u = fields["T¹"].grid.nodes
    f = lambda x: 1 + 10 * np.exp(-(x**2))  # noqa: E731
    np.testing.assert_allclose(fields["T³"].tensors[..., 0, 0], f(u[..., 1]))
    np.testing.assert_allclose(fields["T³"].tensors[..., 1, 1], f(u[..., 0]))
    np.testing.assert_allclose(fields["T⁴"].tensors[..., 0, 0], f(np.linalg.norm(u, axis=-1)))
    # T¹ is flat, T² is not.
    np.testing.assert_allclose(hj.gaussian_curvature(fields["T¹"]), 0, atol=1e-13)
    assert np.abs(hj.gaussian_curvature(fields["T⁴"])).max() > 0.1


@pytest.mark.slow
def test_figure4_fields_have_constant_eigenvalues():
    for name, field in examples.figure4_fields(9).items():
        values = np.linalg.eigvalsh(field.tensors)
        np.testing.assert_allclose(values, np.broadcast_to([1, 4], values.shape), err_msg=name)
        curvature = np.abs(hj.gaussian_curvature(field)).max()
        assert curvature < 1e-10 if name in ("straight", "circles", "spirals") else curvature > 1


@pytest.mark.parametrize("index", [-2, -1.5, -1, -0.5, 0.5, 1, 1.5, 2, 2.5, 3])
def test_degenerate_points_have_their_index(index):
    field = examples.degenerate_point_field(index, 21)
    radius = np.linalg.norm(field.grid.nodes, axis=-1)
    values = np.linalg.eigvalsh(field.tensors)
    np.testing.assert_allclose(values, 10 + 3 * np.stack([-radius, radius], axis=-1), atol=1e-12)
    circle = np.linspace(0, 2 * np.pi, 200)
    around = jax.vmap(field.function)(jnp.stack([0.5 * jnp.cos(circle), 0.5 * jnp.sin(circle)], axis=-1))
    direction = np.linalg.eigh(around)[1][..., 1]
    turned = np.unwrap(2 * np.arctan2(direction[:, 1], direction[:, 0])) / 2
    assert (turned[-1] - turned[0]) / (2 * np.pi) == pytest.approx(index)


def test_curvature_at_a_degenerate_point_is_right_or_nan():
    # T = 10 + 3((x, ±y), (±y, −x)) is linear, and Brioschi's formula leaves (Γ₁₂² − Γ₁₁Γ₂₂)/10/100, with
    # Γ₁₂ = (0, −1.5), Γ₁₁ = (1.5, 0) and Γ₂₂ = (±3 + 1.5, 0).
    for index, expected in ((0.5, (2.25 - 6.75) / 1000), (-0.5, (2.25 + 2.25) / 1000)):
        curvature = hj.gaussian_curvature(examples.degenerate_point_field(index, 3))[1, 1]
        assert curvature == pytest.approx(expected)
    curvature = hj.gaussian_curvature(examples.degenerate_point_field(1.5, 3))
    assert np.argwhere(np.isnan(curvature)).tolist() == [[1, 1]]


@pytest.mark.parametrize("index", [0, 0.3])
def test_impossible_indices_are_refused(index):
    with pytest.raises(ValueError, match=f"index: got {index}; expected a non-zero multiple of 1/2"):
        examples.degenerate_point_field(index, 9)


@pytest.mark.parametrize("shape", [(40, 48), (24, 28, 12)])
def test_phantom_is_a_field_of_plausible_diffusion_tensors(shape):
    tensors, mask, spacing = phantom(shape)
    assert (len(spacing), mask.shape) == (len(shape), shape)
    values = np.linalg.eigvalsh(tensors[mask])
    assert values.min() > 2e-4
    assert values.max() < 3.1e-3
    anisotropy = (values[:, -1] - values[:, 0]) / values.sum(axis=1)
    assert anisotropy.max() > 0.3  # white matter
    assert (anisotropy < 0.05).mean() > 0.1  # grey matter, fluid
    field = hj.TensorField.from_diffusion(hj.Grid(shape, spacing, mask=mask), tensors, metric="inverse")
    assert np.isfinite(field.domain_tensors).all()
