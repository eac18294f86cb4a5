"""Stiffness and mass against scikit-fem's own assembly of the same weak form, and against closed forms."""

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import skfem
from annotations import unchecked
from fields import flat, random_spd
from forms import laplace_beltrami
from scipy.linalg import expm, logm
from scipy.sparse import csc_matrix
from skfem.models.poisson import laplace, mass

import hks_jax as hj
from hks_jax.fem import integrals


def skfem_matrices(grid: hj.Grid, tensors: np.ndarray, metric_of=lambda T: T) -> tuple[csc_matrix, csc_matrix]:
    """Assemble the weak form with scikit-fem, nodes numbered like the grid's; the metric is that of the interpolant."""
    d = grid.dimension
    mesh = (skfem.MeshQuad if d == 2 else skfem.MeshHex).init_tensor(*grid.axes)
    basis = skfem.Basis(mesh, skfem.ElementQuad1() if d == 2 else skfem.ElementHex1(), intorder=3)
    index = np.rint((mesh.p.T - grid.origin) / grid.spacing).astype(int)
    to_grid = np.ravel_multi_index(tuple(index.T), grid.shape)
    nodal = tensors.reshape(-1, d, d)[to_grid]
    parts = {f"t{a}{b}": basis.interpolate(nodal[:, a, b]) for a in range(d) for b in range(d)}

    def metric(w):
        rows = [np.stack([np.asarray(w[f"t{a}{b}"]) for b in range(d)], -1) for a in range(d)]
        return metric_of(np.stack(rows, -2))

    order = np.argsort(to_grid)
    return tuple(csc_matrix(form.assemble(basis, **parts))[order][:, order] for form in laplace_beltrami(metric))


@pytest.mark.parametrize("shape", [(6, 8), (4, 5, 6)])
def test_agrees_with_scikit_fem(rng, shape):
    grid = hj.Grid(shape, (0.3, 0.7, 0.5)[: len(shape)], (1.0, -2.0, 0.5)[: len(shape)])
    tensors = random_spd(rng, shape)
    pencil = hj.assemble(hj.TensorField(grid, tensors))
    for ours, theirs in zip((pencil.stiffness, pencil.mass), skfem_matrices(grid, tensors), strict=True):
        assert abs(ours.to_scipy() - theirs).max() <= 1e-12 * abs(theirs).max()


@pytest.mark.parametrize("shape", [(4, 5), pytest.param((3, 3, 4), marks=pytest.mark.slow)])
def test_log_euclidean_interpolation_agrees_with_scikit_fem_and_commutes_with_inversion(rng, shape):
    grid = hj.Grid(shape, (0.3, 0.7, 0.5)[: len(shape)])
    D = random_spd(rng, shape)
    logarithms = np.stack([logm(T) for T in D.reshape(-1, *D.shape[-2:])]).reshape(D.shape)
    for metric, metric_of in (("tensor", expm), ("inverse", lambda L: np.linalg.inv(expm(L)))):
        field = hj.TensorField.from_diffusion(grid, D, metric, interpolation="log-euclidean")
        pencil = hj.assemble(field)
        for ours, theirs in zip(
            (pencil.stiffness, pencil.mass), skfem_matrices(grid, logarithms, metric_of), strict=True
        ):
            assert abs(ours.to_scipy() - theirs).max() <= 1e-12 * abs(theirs).max()


def test_mesh_agrees_with_scikit_fem_in_the_plane_and_with_cotangents_in_space(rng):
    planar = skfem.MeshTri().refined(3)
    mesh = hj.SurfaceMesh(np.pad(planar.p.T, [(0, 0), (0, 1)]), planar.t.T)
    basis = skfem.Basis(planar, skfem.ElementTriP1())
    pencil = hj.assemble(mesh)
    assert abs(pencil.stiffness.to_scipy() - laplace.assemble(basis)).max() <= 1e-12
    assert abs(pencil.mass.to_scipy() - mass.assemble(basis)).max() <= 1e-14

    vertices = np.array(mesh.vertices) + 0.1 * rng.standard_normal(mesh.vertices.shape)
    expected = np.zeros((len(vertices),) * 2)
    for face in mesh.faces:
        for i in range(3):
            o, p, q = face[i], face[i - 2], face[i - 1]
            u, v = vertices[p] - vertices[o], vertices[q] - vertices[o]
            weight = 0.5 * (u @ v) / np.linalg.norm(np.cross(u, v))
            expected[[p, q], [q, p]] -= weight
            expected[[p, q], [p, q]] += weight
    got = hj.assemble(hj.SurfaceMesh(vertices, mesh.faces)).stiffness.to_dense()
    np.testing.assert_allclose(got, expected, atol=1e-12)


@pytest.mark.parametrize(
    ("boundary", "masked"),
    [("neumann", True), ("dirichlet", False), ("periodic", True), ((("neumann", "dirichlet"), "periodic"), False)],
)
def test_products_dense_and_scipy_forms_agree(rng, boundary, masked):
    shape = (7, 8)
    mask = None
    if masked:
        mask = np.ones(shape, dtype=bool)
        mask[:2, :3] = mask[6, 7] = False
    pencil = hj.assemble(hj.TensorField(hj.Grid(shape, mask=mask), random_spd(rng, shape)), boundary)
    x = jnp.asarray(rng.standard_normal((pencil.space.n_dof, 3)))
    for operator in (pencil.stiffness, pencil.mass):
        dense = operator.to_dense()
        np.testing.assert_allclose(dense, dense.T, atol=1e-14)
        np.testing.assert_allclose(operator @ x, dense @ x, atol=1e-12)
        np.testing.assert_allclose(operator.of_columns()(x), dense @ x, atol=1e-12)
        np.testing.assert_allclose(operator @ x[:, 0], dense @ x[:, 0], atol=1e-12)
        np.testing.assert_allclose(operator.to_scipy().toarray(), dense, atol=1e-15)
        np.testing.assert_allclose(operator.diagonal(), np.diag(dense), atol=1e-15)
    nothing = pencil.stiffness @ jnp.asarray((pencil.space.null_labels >= 0).astype(float))
    np.testing.assert_allclose(nothing, 0, atol=1e-12)
    with pytest.raises(ValueError, match=r"@: got an array of shape \(3,\)"):
        pencil.mass @ jnp.ones(3)


def test_periodic_assembly_is_the_folded_one(rng):
    """Unrolling one period with its end repeated and identifying the ends gives the periodic matrices."""
    shape, tensors = (5, 6), random_spd(rng, (5, 6))
    periodic = hj.assemble(hj.TensorField(hj.Grid(shape), tensors), "periodic")
    unrolled = hj.assemble(hj.TensorField(hj.Grid((6, 7)), np.pad(tensors, [(0, 1), (0, 1), (0, 0), (0, 0)], "wrap")))
    fold = np.zeros((42, 30))
    for i in range(6):
        for j in range(7):
            fold[i * 7 + j, (i % 5) * 6 + j % 6] = 1
    for name in ("stiffness", "mass"):
        big, small = getattr(unrolled, name).to_dense(), getattr(periodic, name).to_dense()
        np.testing.assert_allclose(fold.T @ big @ fold, small, atol=1e-13)


@pytest.mark.parametrize("shape", [(8, 5), pytest.param((8, 4, 5), marks=pytest.mark.slow)])
def test_elements_in_slabs_sum_to_the_same_matrices_and_derivatives(rng, monkeypatch, shape):
    """Large grids are assembled a few planes of elements at a time; the last slab overlaps the one before it."""
    d, raw = len(shape), integrals._compiled_integrals.__wrapped__
    monkeypatch.setattr(
        integrals, "_grid_integrals", lambda settings, *arrays: jax.jit(partial(raw, settings))(*arrays)
    )
    inside = np.ones(shape, bool)
    inside[:3, 0] = False
    grid, tensors = hj.Grid(shape, 0.3, mask=inside), jnp.asarray(random_spd(rng, shape))
    density = jnp.asarray(rng.uniform(1, 2, shape))
    boundary, elements = ("periodic", "neumann", "dirichlet")[:d], (8, *(n - 1 for n in shape[1:]))
    potential = jnp.asarray(rng.uniform(1, 2, elements))
    weights = rng.standard_normal((2, 3**d, *shape))

    def loss(tensors, density, potential):
        pencil = hj.assemble(hj.TensorField(grid, tensors), boundary, density=density, potential=potential)
        both = jnp.stack([pencil.stiffness.coefficients, pencil.mass.coefficients])
        return jnp.sum(weights * both), (both, pencil.volume)

    found = []
    for planes in (8, 3):
        monkeypatch.setattr(integrals, "_AT_ONCE", planes * 4**d * math.prod(elements[1:]))
        found.append(jax.value_and_grad(loss, argnums=(0, 1, 2), has_aux=True)(tensors, density, potential))
    for whole, in_slabs in zip(*map(jax.tree.leaves, found), strict=True):
        np.testing.assert_allclose(in_slabs, whole, atol=1e-12 * np.abs(whole).max())


def test_volume_counts_eliminated_nodes_and_lumping_keeps_it(rng):
    field = flat((9, 5), (2.0, 3.0))
    for boundary in ("neumann", "dirichlet"):
        assert hj.assemble(field, boundary).volume == pytest.approx(6.0)
    lumped = hj.assemble(field, mass="lumped")
    assert jnp.sum(lumped.mass.diagonal()) == pytest.approx(6.0)
    np.testing.assert_allclose(lumped.mass @ jnp.ones(45), hj.assemble(field).mass @ jnp.ones(45), atol=1e-15)


def test_lumped_mass_is_the_integral_of_the_basis_function_also_beside_eliminated_nodes():
    field = flat((6, 6), (1.0, 1.0))
    np.testing.assert_allclose(hj.assemble(field, "dirichlet", "lumped").mass.diagonal(), 1 / 25, rtol=1e-13)
    square = skfem.MeshTri().refined(3)
    mesh = hj.SurfaceMesh(np.pad(square.p.T, [(0, 0), (0, 1)]), square.t.T)
    lumped = hj.assemble(mesh, mass="lumped").mass.diagonal()
    inner = ~mesh.triangulation.boundary_vertices
    np.testing.assert_allclose(hj.assemble(mesh, "dirichlet", "lumped").mass.diagonal(), lumped[inner], rtol=1e-13)


def test_dirichlet_that_nothing_feels_is_reported():
    mask = np.zeros((8, 8), dtype=bool)
    mask[2:6, 2:6] = True
    field = hj.TensorField(hj.Grid((8, 8), mask=mask), np.broadcast_to(np.eye(2), (8, 8, 2, 2)))
    with pytest.warns(hj.AccuracyWarning, match="which the mask does not reach"):
        hj.assemble(field, "dirichlet")


def test_a_batch_is_refused_with_the_remedy(rng):
    grid = hj.Grid((4, 5))
    fields = jax.vmap(lambda T: hj.TensorField(grid, T))(jnp.stack([jnp.asarray(random_spd(rng, (4, 5)))] * 2))
    with pytest.raises(ValueError, match="domain: got a batch of tensor fields; expected one"):
        hj.assemble(fields)


def test_nodes_outside_the_mask_have_no_influence_and_no_gradient(rng):
    shape = (6, 7)
    mask = np.ones(shape, dtype=bool)
    mask[:3, :3] = False
    grid, tensors = hj.Grid(shape, mask=mask), jnp.asarray(random_spd(rng, shape))

    def energy(T):
        pencil = hj.assemble(hj.TensorField(grid, T))
        x = jnp.cos(jnp.arange(pencil.space.n_dof))
        return x @ (pencil.stiffness @ x) + x @ (pencil.mass @ x)

    poisoned = np.array(tensors)
    poisoned[:3, :3] = np.nan
    assert energy(poisoned) == energy(tensors)
    gradient = np.asarray(jax.grad(energy)(poisoned))
    assert np.isfinite(gradient).all()
    np.testing.assert_array_equal(gradient[:3, :3], 0)
    assert (np.abs(gradient[mask]).max(axis=(-2, -1)) > 0).all()


def test_assembly_batches_like_a_loop(rng):
    grid = hj.Grid((5, 6))
    batch = jnp.asarray(np.stack([random_spd(rng, (5, 6)) for _ in range(3)]))

    def stiffness(T):
        return hj.assemble(hj.TensorField(grid, T), "dirichlet").stiffness.coefficients

    looped = jnp.stack([stiffness(T) for T in batch])
    np.testing.assert_allclose(jax.vmap(stiffness)(batch), looped, atol=1e-14)
    assert looped.shape == (3, 9, 5, 6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"boundary": "robin"},
            "boundary: got 'robin'; expected one of 'neumann', 'dirichlet', 'mean', 'periodic', 'mirror'",
        ),
        ({"boundary": ("neumann",) * 4}, r"boundary: got .* expected one name, or a tuple of 2"),
        ({"boundary": (("neumann", "periodic"), "neumann")}, "on both sides"),
        ({"boundary": None}, "boundary: got None; expected one name"),
        ({"boundary": (("neumann",) * 3, "neumann")}, r"boundary: got .* for one axis; expected a name or a pair"),
        ({"mass": "full"}, 'mass: got \'full\'; expected "consistent" or "lumped"'),
    ],
)
def test_unknown_settings_are_named(arguments, message):
    with unchecked(), pytest.raises(ValueError, match=message):
        hj.assemble(flat((4, 4), (1, 1)), **arguments)


def test_impossible_boundaries_are_explained():
    with pytest.raises(ValueError, match="every node of the domain is on a Dirichlet side"):
        hj.assemble(flat((2, 5), (1, 1)), "dirichlet")
    with pytest.raises(ValueError, match="periodic axis needs at least 3 nodes"):
        hj.assemble(flat((2, 5), (1, 1)), "periodic")
    with (
        unchecked(),
        pytest.raises(TypeError, match="domain: got ndarray; expected a TensorField, a SurfaceMesh or a TetMesh"),
    ):
        hj.assemble(np.eye(3))
