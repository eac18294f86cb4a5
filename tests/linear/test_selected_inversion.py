"""The diagonal of a sparse matrix' inverse on the elimination tree, against dense inverses, and its derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from differences import directional
from fields import flat, random_spd

import hks_jax as hj
from hks_jax.linear.dissection import dissect
from hks_jax.linear.operators import shifted
from hks_jax.linear.selected_inversion import inverse_entries, inversion_cost

POLE = jnp.asarray(-40.0 + 90.0j)
MIXED = (("neumann", "dirichlet"), "periodic")

diagonal = jax.jit(inverse_entries)


def random_field(shape, mask=None, seed=3):
    return hj.TensorField(
        hj.Grid(shape, 0.1, mask=mask, components="all"), random_spd(np.random.default_rng(seed), shape, 0.4)
    )


def slotted(shape):
    """A mask that leaves two parts, one of them a single element wide."""
    mask = np.ones(shape, bool)
    mask[:, -3] = False
    return mask


def open_mesh():
    x, y = np.meshgrid(np.arange(9.0), np.arange(8.0), indexing="ij")
    corner = (np.arange(8)[:, None] * 8 + np.arange(7)).ravel()
    faces = np.concatenate(
        [np.stack([corner, corner + 8, corner + 9], 1), np.stack([corner, corner + 9, corner + 1], 1)]
    )
    return hj.SurfaceMesh(np.stack([x, y, np.sin(0.4 * x * y)], -1).reshape(-1, 3), faces)


DOMAINS = {
    "square": lambda: (random_field((15, 13)), "neumann", "consistent"),
    "mixed": lambda: (random_field((14, 16)), MIXED, "lumped"),
    "torus": lambda: (random_field((13, 12)), ("periodic", "periodic"), "consistent"),
    "Dirichlet": lambda: (random_field((12, 15)), "dirichlet", "consistent"),
    "slot": lambda: (random_field((12, 13), slotted((12, 13))), "neumann", "lumped"),
    "few nodes": lambda: (random_field((3, 4)), "neumann", "consistent"),
    "volume": lambda: (random_field((6, 7, 8)), ("periodic", "neumann", "dirichlet"), "consistent"),
    "closed mesh": lambda: (hj.examples.bumpy_torus_mesh(10), "neumann", "consistent"),
    "ball": lambda: (hj.examples.ball_mesh(4), "neumann", "consistent"),
    "open mesh": lambda: (open_mesh(), "dirichlet", "lumped"),
}


def entries_and_dense(pencil, shift=POLE):
    matrix = pencil.stiffness.to_dense().astype(complex) - shift * pencil.mass.to_dense().astype(complex)
    return shifted(pencil.stiffness, pencil.mass, shift), np.asarray(matrix)


@pytest.mark.parametrize(
    "name", [n if n in ("slot", "few nodes") else pytest.param(n, marks=pytest.mark.slow) for n in DOMAINS]
)
def test_it_is_the_diagonal_of_the_dense_inverse(name):
    pencil = hj.assemble(*DOMAINS[name]())
    entries, matrix = entries_and_dense(pencil)
    expected = np.diag(np.linalg.inv(matrix))
    found = diagonal(dissect(pencil.pattern), entries)
    assert found.shape == (pencil.size,)
    np.testing.assert_allclose(found, expected, atol=1e-12 * np.abs(expected).max())


@pytest.mark.slow
def test_real_definite_matrices_and_single_precision():
    pencil = hj.assemble(*DOMAINS["square"]())
    tree = dissect(pencil.pattern)
    entries = pencil.shifted(jnp.asarray(-30.0))
    expected = np.diag(np.linalg.inv(pencil.stiffness.to_dense() + 30 * pencil.mass.to_dense()))
    np.testing.assert_allclose(diagonal(tree, entries), expected, rtol=1e-12)
    single = diagonal(tree, entries.astype(jnp.float32))
    assert single.dtype == jnp.float32
    np.testing.assert_allclose(single, expected, rtol=1e-4)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param("torus", marks=pytest.mark.slow),
        pytest.param("slot", marks=pytest.mark.slow),
        "open mesh",
        pytest.param("ball", marks=pytest.mark.slow),
    ],
)
def test_derivatives_in_both_modes(name):
    """d diag(A⁻¹) = −diag(A⁻¹ dA A⁻¹), for a complex symmetric A; and by the entries, one after another, at no loss."""
    pencil = hj.assemble(*DOMAINS[name]())
    tree, rng = dissect(pencil.pattern), np.random.default_rng(0)
    entries, matrix = entries_and_dense(pencil)
    inverse = np.linalg.inv(matrix)
    weights = rng.standard_normal(pencil.size) + 1j * rng.standard_normal(pencil.size)
    # Directions that keep the matrix symmetric: multiples of K and M.
    for shift in (jnp.asarray(0.0j), jnp.asarray(1e4 - 2e3j)):
        change, dense_change = entries_and_dense(pencil, shift)
        expected = -np.diag(inverse @ dense_change @ inverse)
        _, tangent = jax.jit(lambda change: jax.jvp(lambda e: inverse_entries(tree, e), (entries,), (change,)))(change)
        np.testing.assert_allclose(tangent, expected, atol=1e-11 * np.abs(expected).max())
        slope = jax.jit(jax.grad(lambda e: jnp.sum((weights * inverse_entries(tree, e)).real)))(entries)
        np.testing.assert_allclose(jnp.sum(slope * change).real, (weights @ expected).real, rtol=1e-10)


@pytest.mark.slow
def test_work_and_memory_grow_as_they_do_in_the_plane_and_in_space():
    def ratio(small, large):
        costs = [inversion_cost(dissect(hj.assemble(flat(s, (1.0,) * len(s))).pattern)) for s in (small, large)]
        return np.divide(costs[1], costs[0])

    operations, entries = ratio((32, 32), (128, 128))
    assert 16**1.3 < operations < 16**1.55
    assert 16 < entries < 16**1.25
    operations, entries = ratio((8, 8, 8), (16, 16, 16))
    assert 8**1.5 < operations < 8**2.1
    assert entries < 8**1.5


@pytest.mark.slow
def test_memory_of_a_gradient_grows_neither_with_poles_nor_with_times():
    field = random_field((24, 22))

    def bytes_of(times):
        def loss(tensors):
            moved = hj.TensorField(field.grid, tensors)
            return jnp.sum(hj.hks_spectrum_free(moved, times, method="selected-inversion"))

        return jax.jit(jax.grad(loss)).lower(field.tensors).compile().memory_analysis().temp_size_in_bytes

    assert bytes_of(jnp.geomspace(0.01, 1.0, 8)) - bytes_of(jnp.array([0.01])) < 8 * 20 * 24 * 22 * 8


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::hks_jax.AccuracyWarning")
def test_signature_of_a_mesh_and_its_derivative_by_the_vertices():
    mesh, times = open_mesh(), jnp.array([0.3, 2.0])
    exact = hj.hks(hj.eigenpairs(mesh, 72, solver="dense"), times)
    np.testing.assert_allclose(hj.hks_spectrum_free(mesh, times), exact, rtol=1e-9)
    rng = np.random.default_rng(2)
    probe, direction = rng.standard_normal(exact.shape), jnp.asarray(rng.standard_normal(mesh.vertices.shape))

    @jax.jit
    def loss(vertices):
        return jnp.sum(probe * hj.hks_spectrum_free(hj.SurfaceMesh(vertices, mesh.faces), times))

    slope = jnp.vdot(jax.grad(loss)(mesh.vertices), direction)
    np.testing.assert_allclose(slope, directional(loss, mesh.vertices, direction, 1e-4), rtol=1e-6)


@pytest.mark.slow
def test_under_vmap():
    fields = jnp.stack([random_field((8, 9), seed=seed).tensors for seed in (1, 2)])
    grid = hj.Grid((8, 9), 0.1)

    def signature(tensors):
        return hj.hks_spectrum_free(hj.TensorField(grid, tensors), [0.02])

    together = jax.vmap(signature)(fields)
    np.testing.assert_allclose(together[1], signature(fields[1]), rtol=1e-11)
