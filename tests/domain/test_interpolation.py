"""Log-Euclidean interpolation of tensors between the nodes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from annotations import unchecked
from differences import directional
from fields import random_spd, turning
from scipy.linalg import expm, logm

import hks_jax as hj
from hks_jax.inverse.unknowns import unknowns_for

LOG = "log-euclidean"


def energy(grid):
    """A function of the tensors that feels every entry of stiffness and mass."""

    def value(tensors):
        pencil = hj.assemble(hj.TensorField(grid, tensors, LOG))
        x = jnp.cos(jnp.arange(pencil.space.n_dof, dtype=tensors.dtype))
        return x @ (pencil.stiffness @ x) + x @ (pencil.mass @ x)

    return value


@pytest.mark.slow
@pytest.mark.parametrize("shape", [(4, 5), (3, 4, 3)])
def test_gradient_agrees_with_differences(rng, shape):
    d = len(shape)
    value = jax.jit(energy(hj.Grid(shape)))
    gradient, forward = jax.jit(jax.grad(value)), jax.jit(lambda T, change: jax.jvp(value, (T,), (change,))[1])
    for tensors in (jnp.broadcast_to(2 * jnp.eye(d), (*shape, d, d)), jnp.asarray(random_spd(rng, shape))):
        direction = rng.standard_normal(tensors.shape)
        direction = jnp.asarray(0.1 * (direction + np.swapaxes(direction, -1, -2)))
        expected = float(directional(value, tensors, direction))
        assert jnp.vdot(gradient(tensors), direction) == pytest.approx(expected, rel=1e-8)
        assert forward(tensors, direction) == pytest.approx(expected, rel=1e-8)


def test_batches_agree_with_a_loop(rng):
    batch = jnp.asarray(np.stack([random_spd(rng, (4, 5)) for _ in range(3)]))

    def stiffness(T):
        return hj.assemble(hj.TensorField(hj.Grid((4, 5)), T, LOG), "dirichlet").stiffness.coefficients

    np.testing.assert_allclose(jax.vmap(stiffness)(batch), jnp.stack([stiffness(T) for T in batch]), atol=1e-14)


@pytest.mark.slow
def test_a_mirror_is_the_reflected_domain(rng):
    grid = hj.Grid((7, 6), (0.2, 0.25))
    x, y = np.moveaxis(grid.nodes, -1, 0)
    tensors = random_spd(rng, grid.shape)
    # Nodal tensors can represent the mirror where T₁₂ vanishes on it.
    tensors[..., 0, 1] *= np.sin(np.pi * x / 1.2) * np.sin(np.pi * y / 1.25)
    tensors[..., 1, 0] = tensors[..., 0, 1]
    field = hj.TensorField(grid, tensors, LOG)
    enlarged = hj.reflect(field, 5)
    assert enlarged.interpolation == LOG
    half = hj.assemble(field)
    whole = hj.assemble(hj.TensorField(hj.Grid((12, 10), grid.spacing), doubled(tensors), LOG), "periodic")
    x = rng.standard_normal(grid.shape)
    even = np.pad(np.pad(x, [(0, 5), (0, 0)], "reflect"), [(0, 0), (0, 4)], "reflect").ravel()
    for part, total in ((half.stiffness, whole.stiffness), (half.mass, whole.mass)):
        assert even @ (total @ jnp.asarray(even)) == pytest.approx(
            float(4 * x.ravel() @ (part @ jnp.asarray(x.ravel())))
        )


def doubled(tensors):
    """The tensors on the periodic grid of twice the size, of which the second half is a mirror image."""
    for axis in (0, 1):
        image = np.flip(tensors, axis)
        image = image[1:-1] if axis == 0 else image[:, 1:-1]
        tensors = np.concatenate([tensors, image * np.array([[1, -1], [-1, 1]])], axis=axis)
    return tensors


@pytest.mark.slow
def test_nodes_outside_the_mask_have_no_influence_and_no_gradient(rng):
    mask = np.ones((6, 7), dtype=bool)
    mask[:3, :3] = False
    value = energy(hj.Grid((6, 7), mask=mask))
    tensors = jnp.asarray(random_spd(rng, (6, 7)))
    poisoned = tensors.at[:3, :3].set(jnp.nan)
    assert value(poisoned) == value(tensors)
    gradient = jax.grad(value)(poisoned)
    assert np.isfinite(gradient).all()
    assert (np.abs(gradient[mask]).max(axis=(-2, -1)) > 0).all()
    np.testing.assert_array_equal(gradient[:3, :3], 0)


@pytest.mark.slow
def test_single_precision(rng):
    tensors = random_spd(rng, (5, 6))
    double = hj.assemble(hj.TensorField(hj.Grid((5, 6)), tensors, LOG)).stiffness.coefficients
    single = hj.assemble(hj.TensorField(hj.Grid((5, 6)), tensors.astype(np.float32), LOG)).stiffness.coefficients
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, double, atol=2e-5)


@pytest.mark.slow
@pytest.mark.parametrize("way", ["linear", LOG])
def test_eigenvalues_of_turning_tensors_converge_at_second_order(way):
    values = []
    for n in (11, 21, 41):
        grid = hj.Grid.from_bounds(-1, 1, (n, n))
        values.append(
            np.asarray(hj.eigenpairs(hj.TensorField(grid, turning(grid.nodes, 3.0, 1.0), way), 6).eigenvalues)
        )
    order = np.log2((values[0][1:] - values[1][1:]) / (values[1][1:] - values[2][1:]))
    assert (order > 1.7).all(), order
    assert (order < 2.4).all(), order


@pytest.mark.slow
def test_whatever_rebuilds_a_field_keeps_its_interpolation(rng):
    grid = hj.Grid((4, 5))
    D = random_spd(rng, (4, 5))
    for field in (
        hj.TensorField.from_diffusion(grid, D, "inverse", interpolation=LOG),
        hj.TensorField.from_function(lambda x: (1 + x @ x) * jnp.eye(2), grid, LOG),
        jax.jit(lambda f: jax.tree.map(lambda leaf: 2 * leaf, f))(hj.TensorField(grid, D, LOG)),
        hj.reflect(hj.TensorField(grid, D, LOG), 2),
    ):
        assert field.interpolation == LOG
    nodal = unknowns_for(LOG, hj.TensorField(grid, D, LOG), hj.assemble(hj.TensorField(grid, D, LOG)).space)
    assert nodal.field(nodal.start()).interpolation == LOG
    assert hj.TensorField(grid, D).interpolation == "linear"
    for make in (hj.TensorField, lambda g, t, i: hj.TensorField.from_diffusion(g, t, "tensor", interpolation=i)):
        with (
            unchecked(),
            pytest.raises(ValueError, match=r'interpolation: got \'cubic\'; expected "linear" or "log-euclidean"'),
        ):
            make(grid, D, "cubic")


def test_triangles_take_the_mean_logarithm_of_the_tangential_parts(rng):
    vertices = rng.standard_normal((3, 3))
    tensors = random_spd(rng, (3, 1, 1))[:, 0, 0]
    edges = np.stack([vertices[1] - vertices[0], vertices[2] - vertices[0]], axis=1)
    frame = np.linalg.qr(edges)[0]
    mean = expm(np.mean([logm(frame.T @ D @ frame) for D in tensors], axis=0))
    coordinates = frame.T @ edges
    for metric, expected in (("tensor", mean), ("inverse", np.linalg.inv(mean))):
        mesh = hj.SurfaceMesh.from_tensors(vertices, [[0, 1, 2]], tensors, metric, at="vertices", interpolation=LOG)
        np.testing.assert_allclose(mesh.metric[0], coordinates.T @ expected @ coordinates, rtol=1e-12)
    # What the tensors do across the surface does not matter.
    normal = np.cross(edges[:, 0], edges[:, 1])
    across = tensors - 3 * np.outer(normal, normal) / (normal @ normal)
    flat = hj.SurfaceMesh.from_tensors(vertices, [[0, 1, 2]], across, "inverse", at="vertices", interpolation=LOG)
    np.testing.assert_allclose(flat.metric, mesh.metric, rtol=1e-11)
    with unchecked(), pytest.raises(ValueError, match="interpolation: got 'cubic'"):
        hj.SurfaceMesh.from_tensors(vertices, [[0, 1, 2]], tensors, "tensor", at="vertices", interpolation="cubic")
