import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fields import flat, random_spd

import hks_jax as hj

TIMES = [0.5, 2.0, 5.0]


def mirrored_torus(field: hj.TensorField) -> hj.TensorField:
    """The field really doubled along every axis, on a periodic grid of 2(n − 1) nodes."""
    tensors = np.asarray(field.tensors)
    for axis, n in enumerate(field.grid.shape):
        image = np.take(tensors, range(n - 2, 0, -1), axis=axis).copy()
        for b in range(field.grid.dimension):
            if b != axis:
                image[..., axis, b] *= -1
                image[..., b, axis] *= -1
        tensors = np.concatenate([tensors, image], axis=axis)
    return hj.TensorField(hj.Grid(tensors.shape[:-2], field.grid.spacing), tensors)


def field_diagonal_on_the_sides(rng, shape) -> hj.TensorField:
    tensors = random_spd(rng, shape)
    for axis in range(len(shape)):
        for end in (0, -1):
            face = tensors[(slice(None),) * axis + (end,)]
            face *= np.eye(len(shape))
    return hj.TensorField(hj.Grid(shape, 0.2), tensors)


IN_3D = pytest.param((3, 4, 3), "consistent", marks=pytest.mark.slow)


@pytest.mark.slow
@pytest.mark.parametrize(("shape", "mass"), [((7, 9), "lumped"), ((7, 9), "consistent"), IN_3D])
def test_mirror_is_the_really_doubled_torus(rng, shape, mass):
    field = field_diagonal_on_the_sides(rng, shape)
    doubled = mirrored_torus(field)
    mirror = hj.eigenpairs(field, doubled.grid.size, "mirror", mass=mass)
    torus = hj.eigenpairs(doubled, doubled.grid.size, "periodic", mass=mass)
    # λ_max is about 1e3; rounding in the solver is relative to it
    np.testing.assert_allclose(mirror.eigenvalues, torus.eigenvalues, atol=1e-10)
    original = (slice(None), *[slice(n) for n in shape])
    times = jnp.asarray(TIMES)
    got = hj.hks(mirror, times)
    np.testing.assert_allclose(got, hj.hks(torus, times)[original], atol=0, rtol=1e-12)
    assert mirror.pencil.volume == pytest.approx(float(torus.pencil.volume))


@pytest.mark.slow
@pytest.mark.parametrize("mass", [pytest.param("consistent", marks=pytest.mark.slow), "lumped"])
def test_mirror_is_the_mean_of_the_mixed_problems(rng, mass):
    field = hj.TensorField(hj.Grid((6, 7), 0.3), random_spd(rng, (6, 7)))
    n, d = ("neumann", "neumann"), ("dirichlet", "dirichlet")
    mixed = [
        hj.hks(hj.eigenpairs(field, hj.assemble(field, b).space.n_dof, b, mass=mass), TIMES)
        for b in [(n, n), (n, d), (d, n), (d, d)]
    ]
    total = 42 + 30 + 28 + 20
    mirror = hj.eigenpairs(field, total, "mirror", mass=mass)
    np.testing.assert_allclose(hj.hks(mirror, TIMES), np.mean(mixed, axis=0), rtol=1e-11)


@pytest.mark.slow
def test_a_mirror_part_too_small_for_lanczos_is_solved_densely():
    field = flat((20, 4), (1.0, 0.2))

    def signature(T):
        pairs = hj.eigenpairs(hj.TensorField(field.grid, T), 37, "mirror", "shift-invert")
        return hj.hks(pairs, jnp.array([0.05])), pairs.eigenvalues

    eager = signature(field.tensors)
    np.testing.assert_allclose(jax.jit(signature)(field.tensors)[1], eager[1], rtol=1e-9, atol=1e-9)


@pytest.mark.slow
def test_truncated_mirror_spectrum_misses_nothing(rng):
    # Long and thin: nearly all low modes belong to two of the four problems, not to a fair share of each.
    field = hj.TensorField(hj.Grid((60, 4), (1.0, 0.05)), random_spd(rng, (60, 4), 0.1))
    whole = hj.eigenpairs(field, 60 * 4 + 60 * 2 + 58 * 4 + 58 * 2, "mirror")
    np.testing.assert_allclose(hj.eigenpairs(field, 40, "mirror").eigenvalues, whole.eigenvalues[:40], atol=1e-8)


@pytest.mark.slow
def test_mirror_removes_the_boundary_effect_of_a_flat_metric():
    field = flat((17, 17), (1.0, 1.0))
    t = [0.01]
    assert np.ptp(hj.hks(hj.eigenpairs(field, 289), t, "flat")) > 2.5  # ×4 in the corners
    mirror = hj.hks(hj.eigenpairs(field, 1024, "mirror"), t, "flat")
    assert np.ptp(mirror) < 1e-10


def test_mirror_of_one_axis_only():
    field = flat((9, 10), (1.0, 1.0), (False, True))
    pairs = hj.eigenpairs(field, 9 * 10 + 7 * 10, ("mirror", "periodic"))
    values = hj.hks(pairs, [0.02], "flat")
    assert np.ptp(values) < 1e-10
    assert pairs.pencil.volume == pytest.approx(2.0)


def test_reflected_strip_is_an_isometry_and_crops_back(rng):
    field = field_diagonal_on_the_sides(rng, (8, 9))
    enlarged = hj.reflect(field, 3)
    assert enlarged.grid.shape == (14, 15)
    np.testing.assert_allclose(enlarged.grid.nodes[3:-3, 3:-3], field.grid.nodes)
    np.testing.assert_array_equal(
        hj.crop(jnp.moveaxis(enlarged.tensors, (0, 1), (2, 3)), field.grid)[0, 1], field.tensors[..., 0, 1]
    )
    # T₁₂ is odd about the mirror, T₁₁ and T₂₂ even.
    np.testing.assert_array_equal(enlarged.tensors[2, 3:-3, 0, 1], -field.tensors[1, :, 0, 1])
    np.testing.assert_array_equal(enlarged.tensors[2, 3:-3, 0, 0], field.tensors[1, :, 0, 0])
    # Beyond both high sides lies the same as on the doubled torus: twice negated T₁₂ in the corner.
    torus = np.asarray(mirrored_torus(field).tensors)
    np.testing.assert_array_equal(hj.reflect(field, 6).tensors[6:, 6:], torus[:, :15])
    three = hj.reflect(hj.TensorField(hj.Grid((4, 4, 4)), random_spd(rng, (4, 4, 4))), 2)
    assert three.tensors.shape == (8, 8, 8, 3, 3)


def test_reflection_moves_the_boundary_effect_outside():
    field = flat((13, 13), (1.0, 1.0))
    t = [0.01]
    enlarged = hj.reflect(field, 6)
    reflected = hj.hks(hj.eigenpairs(enlarged, enlarged.grid.size), t, "flat")
    inner = hj.crop(reflected, field.grid)
    assert inner.shape == (1, 13, 13)
    assert np.ptp(inner) < 1e-3 < 1 < np.ptp(reflected)


def test_reflect_and_crop_name_bad_arguments():
    field = flat((5, 6), (1.0, 1.0))
    with pytest.raises(ValueError, match="width: got 5; expected 1 … 4 nodes"):
        hj.reflect(field, 5)
    with pytest.raises(ValueError, match=r"values: got trailing shape \(6, 7\)"):
        hj.crop(np.zeros((2, 6, 7)), field.grid)


@pytest.mark.slow
def test_neumann_doubles_at_an_edge_and_quadruples_in_a_corner():
    pairs = hj.eigenpairs(flat((21, 21), (1.0, 1.0)), 441)
    values = hj.hks(pairs, [0.02], "flat")[0]
    np.testing.assert_allclose([values[10, 10], values[0, 10], values[0, 0]], [1, 2, 4], rtol=0.01)
    cube = hj.eigenpairs(flat((7, 7, 7), (1.0, 1.0, 1.0)), 343)
    corner = hj.hks(cube, [0.06], "flat")[0][0, 0, 0]
    assert corner == pytest.approx(8, rel=0.05)
