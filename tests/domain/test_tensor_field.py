from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from annotations import unchecked
from fields import random_spd

import hks_jax as hj
from hks_jax.domain import spd, tensor_checks


@pytest.mark.parametrize("shape", [(4, 5), (3, 4, 5)])
def test_closed_forms_agree_with_lapack(rng, shape):
    t = random_spd(rng, shape)
    np.testing.assert_allclose(spd.determinant(jnp.asarray(t)), np.linalg.det(t), rtol=1e-13)
    np.testing.assert_allclose(spd.inverse(jnp.asarray(t)), np.linalg.inv(t), rtol=1e-12, atol=1e-13)
    adjugate = np.linalg.det(t)[..., None, None] * np.linalg.inv(t)
    np.testing.assert_allclose(spd.adjugate(jnp.asarray(t)), adjugate, rtol=1e-12, atol=1e-13)


def test_field_is_a_pytree_through_jit_grad_vmap(rng):
    grid = hj.Grid((4, 5))
    tensors = jnp.asarray(random_spd(rng, (4, 5)))
    field = hj.TensorField(grid, tensors)

    def volume(field):
        return jnp.sum(jnp.sqrt(spd.determinant(field.tensors)))

    assert jax.jit(volume)(field) == pytest.approx(float(volume(field)), rel=1e-14)
    gradient = jax.grad(volume)(field).tensors
    # d√|T| = ½ √|T| T⁻¹ : dT
    expected = 0.5 * np.sqrt(np.linalg.det(tensors))[..., None, None] * np.linalg.inv(tensors)
    np.testing.assert_allclose(gradient, expected, rtol=1e-11)
    batch = jax.vmap(lambda T: volume(hj.TensorField(grid, T)))(jnp.stack([tensors, 4 * tensors]))
    np.testing.assert_allclose(batch, [volume(field), 4 * volume(field)], rtol=1e-13)


TRACEABLE = {
    "tensors": lambda f: f.tensors,
    "tensors of the domain": lambda f: f.domain_tensors,
    "stiffness": lambda f: hj.assemble(f, "mirror").parts[0].stiffness.coefficients,
    "Laplace–Beltrami": lambda f: hj.laplace_beltrami(f, jnp.arange(72.0).reshape(8, 9)),
}
READERS = TRACEABLE | {
    "counts": lambda f: hj.weyl_count(hj.assemble(f), [100.0], f),
    "reflected": lambda f: hj.reflect(f, 2).tensors,
    "invariants": hj.tensor_invariants,
    "smoothed": lambda f: hj.gaussian_scale_space(f, [0.1], np.arange(72.0).reshape(8, 9)),
    "resolution": lambda f: hj.assemble(f).resolution,
    "degenerate points": lambda f: np.asarray(hj.degenerate_points(f).positions),
}


@pytest.mark.parametrize("name", READERS)
def test_only_the_symmetric_part_of_a_leaf_is_read(rng, name):
    """As after a step of an optimiser, whose state was not symmetric."""
    grid = hj.Grid((8, 9), 0.1)
    field = hj.TensorField(grid, np.eye(2) + 0.1 * random_spd(rng, (8, 9)))
    skew = 0.3 * rng.standard_normal((8, 9, 1, 1)) * np.array([[0.0, 1.0], [-1.0, 0.0]])
    bent = jax.tree.map(lambda leaf: leaf + skew, field)
    read = READERS[name]
    for f in (read, jax.jit(read)) if name in TRACEABLE else (read,):
        for found, expected in zip(jax.tree.leaves(f(bent)), jax.tree.leaves(read(field)), strict=True):
            np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)


def test_arrays_of_other_byte_order_are_read_and_hidden_values_are_refused(rng):
    grid, tensors = hj.Grid((4, 5)), random_spd(rng, (4, 5))
    given = tensors.astype(">f8")
    field = hj.TensorField(grid, given)
    given[:] = 0  # the field has its own copy
    np.testing.assert_allclose(field.tensors, tensors, atol=1e-15)
    hidden = np.ma.masked_greater(tensors, 1.0)
    with unchecked(), pytest.raises(ValueError, match=r"tensors: got a masked array; .* use \.filled\(value\)"):
        hj.TensorField(grid, hidden)


def test_from_function_keeps_the_function_and_traces_its_parameters():
    grid = hj.Grid.from_bounds(-1, 1, (5, 6))

    def metric(scale, x):
        return scale * jnp.diag(jnp.stack([1 + x[0] ** 2, jnp.ones(())]))

    field = hj.TensorField.from_function(jax.tree_util.Partial(metric, jnp.asarray(2.0)), grid)
    np.testing.assert_allclose(field.tensors[..., 0, 0], 2 * (1 + grid.nodes[..., 0] ** 2))
    doubled = jax.tree.map(lambda leaf: 2 * leaf, field)
    np.testing.assert_allclose(doubled.tensors, 2 * field.tensors)
    assert jax.grad(lambda f: f.tensors[0, 0, 1, 1])(field).function.args[0] == 1.0


def test_three_metrics_of_a_diffusion_tensor(rng):
    grid, D = hj.Grid((3, 4, 5)), random_spd(rng, (3, 4, 5))
    np.testing.assert_allclose(hj.TensorField.from_diffusion(grid, D, metric="tensor").tensors, D)
    inverse = hj.TensorField.from_diffusion(grid, D, metric="inverse").tensors
    np.testing.assert_allclose(inverse @ D, np.broadcast_to(np.eye(3), D.shape), atol=1e-12)
    adjugate = hj.TensorField.from_diffusion(grid, D, metric="adjugate").tensors
    np.testing.assert_allclose(np.linalg.det(adjugate), np.linalg.det(D) ** 2, rtol=1e-11)
    with pytest.raises(
        ValueError, match=r'metric: got None; expected "inverse".*"tensor".*"adjugate".*"fick".*no default'
    ):
        hj.TensorField.from_diffusion(grid, D)
    volume = hj.io.TensorVolume(D, (1.0,) * 3, (0.0,) * 3)
    with (
        unchecked(),
        pytest.raises(TypeError, match=r"grid: got TensorVolume; expected hks_jax.Grid. Pass volume.grid\(\)"),
    ):
        hj.TensorField.from_diffusion(volume, "inverse")
    with (
        unchecked(),
        pytest.raises(ValueError, match=r"mask: got 'mask.nii'; expected a bool array.*`read_mask` reads a file"),
    ):
        volume.with_mask("mask.nii")


def test_values_outside_the_mask_do_not_matter(rng):
    mask = np.ones((5, 5), dtype=bool)
    mask[0] = False
    D = random_spd(rng, (5, 5))
    D[0] = np.nan
    D[0, 0] = 0
    field = hj.TensorField.from_diffusion(hj.Grid((5, 5), mask=mask), D, metric="inverse")
    assert np.isfinite(field.domain_tensors).all()


def corrupted(rng, node, value) -> np.ndarray:
    tensors = random_spd(rng, (4, 5))
    tensors[node] = value
    return tensors


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.nan, r"tensors: 1 of 20 tensors are NaN or infinite \(the first at node \(2, 3\)\).*mask"),
        ([[1, 2], [2, 1]], r"1 of 20 tensors are not positive definite, worst eigenvalue -1 .*node \(2, 3\).*mask"),
        (0, "not positive definite, worst eigenvalue 0"),
        ([[-1, 0], [0, -1]], "worst eigenvalue -1"),
        ([[1, 0.5], [0, 1]], "1 of 20 tensors are unsymmetric.*component order"),
    ],
)
def test_bad_tensors_are_counted_and_located(rng, value, message):
    with pytest.raises(ValueError, match=message):
        hj.TensorField(hj.Grid((4, 5)), corrupted(rng, (2, 3), value))


def test_tensors_checked_in_parts_are_counted_together(monkeypatch):
    tensors = np.tile(np.eye(2), (9, 4, 1, 1))
    monkeypatch.setattr(tensor_checks, "_AT_ONCE", 8)
    assert hj.TensorField(hj.Grid((9, 4)), tensors).tensors.shape == tensors.shape
    tensors[[2, 8], [1, 3], 0, 0] = -1.0
    with pytest.raises(ValueError, match=r"2 of 36 tensors are not positive definite.* at node \(2, 1\)"):
        hj.TensorField(hj.Grid((9, 4)), tensors)


def test_wrong_shapes_and_types_are_named(rng):
    with pytest.raises(ValueError, match=r"tensors: got shape \(5, 4, 2, 2\); expected .* = \(4, 5, 2, 2\)"):
        hj.TensorField(hj.Grid((4, 5)), random_spd(rng, (5, 4)))
    with unchecked(), pytest.raises(TypeError, match=r"grid: got tuple; expected hks_jax\.Grid"):
        hj.TensorField((4, 5), random_spd(rng, (4, 5)))
    with pytest.raises(ValueError, match="fn: 12 of 12 tensors are not positive definite"):
        hj.TensorField.from_function(lambda x: -jnp.eye(2), hj.Grid((3, 4)))
    with pytest.raises(ValueError, match="D: 20 of 20 tensors are not positive definite"):
        hj.TensorField.from_diffusion(hj.Grid((4, 5)), np.zeros((4, 5, 2, 2)), metric="inverse")


def test_functions_are_checked_as_arrays_are():
    grid = hj.Grid((4, 5))
    with pytest.raises(ValueError, match=r"fn: got shape \(4, 5\); expected"):
        hj.TensorField.from_function(lambda x: x[0], grid)
    with pytest.raises(ValueError, match="fn: 20 of 20 tensors are unsymmetric"):
        hj.TensorField.from_function(lambda x: jnp.array([[2.0, 1.0], [0.0, 2.0]]), grid)


def test_a_function_singular_outside_the_mask_spoils_no_gradient():
    grid = hj.Grid.from_bounds(-1, 1, (9, 9))
    grid = hj.Grid(grid.shape, grid.spacing, grid.origin, mask=np.linalg.norm(grid.nodes, axis=-1) < 0.9)

    def volume(scale):
        disk = jax.tree_util.Partial(lambda a, x: a / jnp.sqrt(1 - x @ x) * jnp.eye(2), scale)
        return hj.assemble(hj.TensorField.from_function(disk, grid)).volume

    assert jax.grad(volume)(1.0) == pytest.approx(float(volume(1.0)))


@pytest.mark.parametrize("dtype", [np.float16, jnp.bfloat16])
def test_half_precision_is_read_into_single_precision(dtype):
    grid = hj.Grid.from_bounds(0, 1, (9, 9))
    half = np.asarray(hj.examples.sphere_field(9).tensors).astype(dtype)
    field = hj.TensorField(grid, half)
    assert field.tensors.dtype == np.float32
    np.testing.assert_array_equal(field.tensors, half.astype(np.float32))
    single = hj.smooth_tensors(grid, half.astype(np.float32), 0.2)
    np.testing.assert_array_equal(hj.smooth_tensors(grid, half, 0.2), single)


def test_integer_tensors_become_floating(rng):
    assert hj.TensorField(hj.Grid((2, 2)), np.broadcast_to(np.eye(2, dtype=int), (2, 2, 2, 2))).tensors.dtype == float


@pytest.mark.slow
@pytest.mark.parametrize("d", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_traced_tensors_that_are_not_positive_definite_give_nan(d):
    """Among them −I, whose determinant is positive in the plane, and whose adjugate is I in space."""
    mask = np.ones((9,) * d, dtype=bool)
    mask[0] = False
    grid, node = hj.Grid(mask.shape, 0.3, mask=mask), (4,) * d
    identity = jnp.broadcast_to(jnp.eye(d), (*grid.shape, d, d))
    bad = [-np.eye(d), np.diag([1.0] * (d - 1) + [-0.01]), np.diag([0.0] + [1.0] * (d - 1)), np.ones((d, d))]
    bad = jnp.stack([identity, *(identity.at[node].set(t) for t in bad), identity.at[(0,) * d].set(-jnp.eye(d))])

    @jax.jit
    @jax.vmap
    @partial(jax.value_and_grad, has_aux=True)
    def traced(tensors):
        field = hj.TensorField(grid, tensors)
        pencil = hj.assemble(field)
        inverse = hj.assemble(hj.TensorField.from_diffusion(grid, tensors, "adjugate")).volume
        curvature = hj.gaussian_curvature(field) if d == 2 else hj.scalar_curvature(field)
        return pencil.volume + pencil.stiffness.coefficients.sum(), (inverse, curvature[node])

    (values, others), gradients = traced(bad)
    good = np.array([True, False, False, False, False, True])
    for found in (values, *others, *jnp.moveaxis(gradients[(slice(None), *node)].reshape(6, -1), 1, 0)):
        np.testing.assert_array_equal(np.isfinite(found), good)
    np.testing.assert_allclose(gradients[0], gradients[-1], atol=1e-15)


def test_descriptions_are_one_line(rng):
    field = hj.TensorField(hj.Grid((4, 5)), random_spd(rng, (4, 5)))
    pairs = hj.eigenpairs(field, 3)
    surface = hj.examples.sphere_mesh(2)
    volume = hj.io.TensorVolume(np.array(field.tensors), (1.0, 1.0), (0.0, 0.0))
    for thing, word in (
        (field, "float64 (4, 5, 2, 2)"),
        (pairs, "k=3 of 20"),
        (pairs.pencil, "20 unknowns"),
        (surface, "80 triangles"),
        (volume, "float64 (4, 5, 2, 2)"),
    ):
        text = repr(thing)
        assert word in text
        assert "\n" not in text
        assert len(text) < 300
    traced = []
    jax.make_jaxpr(lambda f: traced.append(repr(f)))(field)
    assert traced == [repr(field)]
