"""Masks of surfaces and solids: against the mesh that is left, renumbered."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from solids import box

import hks_jax as hj

pytestmark = pytest.mark.filterwarnings("ignore::hks_jax.AccuracyWarning")


@pytest.fixture(params=["surface", pytest.param("solid", marks=pytest.mark.slow)])
def whole(request):
    """A mesh's class, vertices and cells, and a mask of its vertices that cuts a corner off."""
    if request.param == "solid":
        vertices, cells = box((5, 4, 5))
        kind = hj.TetMesh
    else:
        torus = hj.examples.bumpy_torus_mesh(10)
        vertices, cells, kind = np.asarray(torus.vertices), torus.faces, hj.SurfaceMesh
    inside = vertices @ [1.0, 0.5, 0.1] < np.quantile(vertices @ [1.0, 0.5, 0.1], 0.75)
    return kind, vertices, cells, inside


def left(kind, vertices, cells, inside):
    kept = cells[inside[cells].all(axis=1)]
    numbers, cells = np.unique(kept, return_inverse=True)
    return kind(vertices[numbers], cells.reshape(kept.shape)), numbers


@pytest.mark.parametrize(
    "boundary", ["mean", *(pytest.param(b, marks=pytest.mark.slow) for b in ("dirichlet", "neumann"))]
)
def test_a_mask_leaves_the_same_as_renumbering(whole, boundary):
    kind, vertices, cells, inside = whole
    other, numbers = left(*whole)
    expected = hj.eigenpairs(other, 4, boundary)
    of_cells = inside[cells].all(axis=1)
    spoilt = np.where(np.isin(np.arange(len(vertices)), numbers)[:, None], vertices, np.nan)
    for mesh in (kind(vertices, cells, mask=inside), kind(spoilt, cells, mask=of_cells)):
        pairs = hj.eigenpairs(mesh, 4, boundary)
        np.testing.assert_allclose(pairs.eigenvalues, expected.eigenvalues, atol=1e-9)
        signature = np.asarray(hj.hks(pairs, [0.1])[0])
        np.testing.assert_allclose(signature[numbers], hj.hks(expected, [0.1])[0], rtol=1e-7, atol=1e-9)
        assert np.isnan(np.delete(signature, numbers)).all()
        assert pairs.pencil.volume == pytest.approx(float(expected.pencil.volume))
        assert pairs.space.n_components == expected.space.n_components
    of_degree_two = [hj.assemble(each, "dirichlet", degree=2) for each in (mesh, other)]
    a, b = (hj.eigenpairs(pencil, 3).eigenvalues for pencil in of_degree_two)
    np.testing.assert_allclose(a, b, rtol=1e-9)


def test_tensors_and_fields_belong_to_all_cells_and_what_is_outside_does_not_count(whole, rng):
    kind, vertices, cells, inside = whole
    kept = inside[cells].all(axis=1)
    nodal = np.broadcast_to(2.0 * np.eye(3), (len(vertices), 3, 3)).copy()
    nodal[~inside] = np.nan
    of_cells = np.where(kept[:, None, None], 2.0 * np.eye(3), np.nan)
    potential = np.where(kept, rng.normal(size=len(cells)), np.nan)
    at_nodes, at_cells = (
        kind.from_tensors(vertices, cells, tensors, "tensor", mask=inside) for tensors in (nodal, of_cells)
    )
    np.testing.assert_allclose(at_nodes.metric, at_cells.metric)
    assert len(at_nodes.metric) == kept.sum()
    first = hj.assemble(at_nodes, potential=potential).stiffness.to_scipy()
    second = hj.assemble(at_cells, potential=potential[kept]).stiffness.to_scipy()
    assert abs(first - second).max() < 1e-12

    def energy(vertices):
        return hj.heat_trace(hj.eigenpairs(kind(vertices, cells, mask=kept), 4), [0.1])[0]

    spoilt = jnp.asarray(np.where(np.isin(np.arange(len(vertices)), cells[kept])[:, None], vertices, np.nan))
    gradient = np.asarray(jax.jit(jax.grad(energy))(spoilt))
    assert np.isfinite(gradient).all()
    assert (np.abs(gradient).max(axis=1) > 0).sum() == np.unique(cells[kept]).size


@pytest.mark.parametrize(
    ("mask", "message"),
    [
        (np.zeros(12, bool), "mask: 0 of 12 vertices are inside, but no triangle"),
        (
            np.ones(5, bool),
            r"mask: got shape \(5,\); expected \(12,\), one for each vertex, or \(20,\), one for",
        ),
        (np.full(12, 2), "mask: got dtype int64 with values other than 0 and 1"),
    ],
)
def test_masks_that_leave_nothing_or_do_not_fit_are_refused(mask, message):
    icosahedron = hj.examples.sphere_mesh(1)
    with pytest.raises(ValueError, match=message):
        hj.SurfaceMesh(icosahedron.vertices, icosahedron.faces, mask=mask)


def test_bad_triangles_and_unused_vertices_are_left_out():
    icosahedron = hj.examples.sphere_mesh(1)
    vertices = np.concatenate([icosahedron.vertices, [[9.0, 9, 9]]])
    faces = np.concatenate([icosahedron.faces, [[0, 0, 1]]])
    with pytest.raises(ValueError, match=r"vertices: 1 of 13 belong to no face .* or exclude them by a mask"):
        hj.SurfaceMesh(vertices, faces)
    mesh = hj.SurfaceMesh(vertices, faces, mask=np.arange(21) < 20)
    values = hj.eigenpairs(mesh, 4).eigenvalues
    np.testing.assert_allclose(values, hj.eigenpairs(icosahedron, 4).eigenvalues, atol=1e-12)
    ambiguous = hj.examples.bumpy_torus_mesh(6)
    with pytest.raises(ValueError, match=r"vertices and as many .* ambiguous"):
        hj.SurfaceMesh(ambiguous.vertices, ambiguous.faces[:36], mask=np.arange(36) < 30)


def with_as_many_faces_inside_as_vertices():
    """A sphere of 42 vertices and 80 faces, with a mask of 42 faces."""
    sphere = hj.examples.sphere_mesh(2)
    inside = np.arange(80) < 42
    return np.asarray(sphere.vertices), sphere.faces, inside


def test_fields_of_all_cells_are_not_nodal_although_as_many_cells_as_vertices_are_inside(rng):
    vertices, faces, inside = with_as_many_faces_inside_as_vertices()
    mesh, of_faces = hj.SurfaceMesh(vertices, faces, mask=inside), rng.uniform(1, 2, 80)
    corners = vertices[faces[inside]]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    nodal = rng.uniform(1, 2, 42)
    for density, expected in ((of_faces, areas @ of_faces[inside]), (nodal, areas @ nodal[faces[inside]].mean(axis=1))):
        mass = hj.assemble(mesh, density=density).mass.to_dense()
        assert float(mass.sum()) == pytest.approx(float(expected))  # ∫ρ


def test_tensors_of_all_cells_are_not_nodal_although_as_many_cells_as_vertices_are_inside(rng):
    vertices, faces, inside = with_as_many_faces_inside_as_vertices()
    scales = rng.uniform(1, 2, 80)
    mesh = hj.SurfaceMesh.from_tensors(vertices, faces, scales[:, None, None] * np.eye(3), "tensor", mask=inside)
    flat = hj.SurfaceMesh(vertices, faces, mask=inside).metric
    np.testing.assert_allclose(mesh.metric, scales[inside, None, None] * flat, rtol=1e-6)
    with pytest.raises(ValueError, match="as many faces as vertices, 42"):  # nodal, or of the faces inside
        hj.SurfaceMesh.from_tensors(vertices, faces, np.broadcast_to(np.eye(3), (42, 3, 3)), "tensor", mask=inside)
