import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hks_jax as hj

TETRAHEDRON = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], dtype=float)
FACES = np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])


def test_a_mesh_is_a_pytree_whose_leaf_is_the_vertices():
    mesh = hj.SurfaceMesh(TETRAHEDRON, FACES)

    def area(mesh):
        return hj.assemble(mesh).volume

    assert area(mesh) == pytest.approx(4 * np.sqrt(3) / 4 * 8)
    gradient = jax.jit(jax.grad(area))(mesh)
    # Area is homogeneous of degree two in the positions (Euler).
    assert jnp.sum(gradient.vertices * mesh.vertices) == pytest.approx(2 * float(area(mesh)))


def test_components_and_rim():
    two = hj.SurfaceMesh(np.concatenate([TETRAHEDRON, TETRAHEDRON + 9]), np.concatenate([FACES, FACES + 4]))
    assert two.triangulation.labels[1] == 2
    np.testing.assert_array_equal(hj.eigenpairs(two, 2).eigenvalues, [0, 0])
    opened = hj.SurfaceMesh(TETRAHEDRON, FACES[:3])
    np.testing.assert_array_equal(opened.triangulation.boundary_vertices, [False, True, True, True])


@pytest.mark.parametrize(
    ("vertices", "faces", "message"),
    [
        (TETRAHEDRON[:, :2], FACES, r"vertices: got shape \(4, 2\); expected \(V, 3\)"),
        (TETRAHEDRON, FACES.astype(float), "faces: got .* expected integers"),
        (TETRAHEDRON, FACES + 1, r"faces: got vertex indices 1 … 4; expected 0 … 3"),
        (TETRAHEDRON, FACES[:1], "vertices: 1 of 4 belong to no face"),
        (TETRAHEDRON * [0, 0, 1], FACES, "faces: 4 of 4 triangles have no area"),
        (TETRAHEDRON * np.nan, FACES, "vertices: 4 are NaN"),
    ],
)
def test_bad_meshes_are_refused(vertices, faces, message):
    with pytest.raises(ValueError, match=message):
        hj.SurfaceMesh(vertices, faces)
