"""The settings with which people look for their own mistakes must not find ours."""

import types
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from annotations import unchecked
from public_calls import CALLS, OTHERS, STEPS, pairs, run_guarded, run_strictly

import hks_jax as hj


def test_every_public_function_has_a_call():
    public = {name for name, value in vars(hj).items() if isinstance(value, types.FunctionType) and name[0] != "_"}
    assert public - OTHERS == {name.split()[0] for name in CALLS} - {"gradient", "push", "factorise"}


@pytest.mark.slow
@pytest.mark.parametrize("name", CALLS)
def test_nothing_is_found_where_nan_and_rank_promotion_are_errors(name):
    run_strictly(name)


@pytest.mark.slow
@pytest.mark.parametrize("name", STEPS)
def test_nothing_is_found_where_leaks_and_transfers_are_errors(name):
    run_guarded(name)


def test_traced_arguments_that_must_be_static_are_named():
    tensors, vertices = np.tile(np.eye(2), (4, 4, 1, 1)), np.eye(4)[:, :3]
    faces, known = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]), pairs()
    calls = {
        "mask": (lambda x: hj.Grid((4, 4), mask=x), np.ones((4, 4), bool)),
        "spacing": (lambda x: hj.Grid((4, 4), (x, x)), 0.1),
        "origin": (lambda x: hj.Grid((4, 4), 1.0, x), 0.1),
        "shape": (lambda x: hj.Grid((x, x)), 4),
        "upper": (lambda x: hj.Grid.from_bounds(0.0, x, (4, 4)), 1.0),
        "faces": (lambda x: hj.SurfaceMesh(vertices, x), faces),
        "k": (lambda x: hj.eigenpairs(hj.TensorField(hj.Grid((4, 4)), tensors), x), 3),
        "sources": (lambda x: hj.heat_kernel(known, [4.0], x), np.array([4, 4])),
        "field": (lambda x: hj.degenerate_points(hj.TensorField(hj.Grid((4, 4)), x)), tensors),
        "labels": (lambda x: hj.region_statistics(np.ones((1, 4, 4)), x), np.ones((4, 4), int)),
        "values": (lambda x: hj.weyl_count(known, x), np.ones(1)),
        "problem": (lambda x: hj.weyl_count(hj.assemble(hj.TensorField(hj.Grid((4, 4)), x)), [1.0]), tensors),
        "width": (lambda x: hj.reflect(hj.TensorField(hj.Grid((4, 4)), tensors), x), 2),
    }
    for name, (call, value) in calls.items():
        with unchecked(), pytest.raises(ValueError, match=rf"^{name}: got a traced value.*static"):
            jax.jit(lambda x, call=call: call(x) and x)(value)
    with pytest.raises(ValueError, match=r"^mask: got a traced value.*static"):
        jax.jit(lambda x: hj.SurfaceMesh(vertices, faces, mask=x))(np.ones(4, bool))


def test_traced_times_that_are_not_positive_give_nan():
    times = jnp.array([-4.0, 0.0, jnp.inf, 4.0])
    values = jax.jit(partial(hj.heat_trace, pairs()))(times)
    np.testing.assert_array_equal(np.isnan(values), [True, True, True, False])


def test_a_number_is_one_time_and_k_may_be_an_array_without_axes():
    np.testing.assert_array_equal(hj.heat_trace(pairs(), 4.0), hj.heat_trace(pairs(), [4.0]))
    with unchecked():
        assert hj.eigenpairs(pairs().pencil, np.asarray(12)).k == 12


def test_an_error_asked_for_begins_with_the_reason():
    broken = hj.TensorField._checked(hj.Grid((4, 4)), "linear", jnp.full((4, 4, 2, 2), jnp.nan))
    with pytest.raises(RuntimeError, match=r"^The matrices are not finite"):
        hj.eigenpairs(broken, 3, throw=True)
    assert "missed none" in repr(pairs().result)


def test_small_problems_and_mirrors_without_a_side_are_refused_by_their_own_names():
    mask = np.zeros((12, 12), bool)
    mask[3:9, 3:9] = True
    inner = hj.TensorField(hj.Grid((12, 12), mask=mask), np.tile(np.eye(2), (12, 12, 1, 1)))
    with pytest.raises(ValueError, match='got "mirror", but the mask reaches no side'):
        hj.eigenpairs(inner, 3, "mirror")
    with pytest.raises(ValueError, match="solver: got 'block-lanczos' for 36 unknowns, which are too few"):
        hj.eigenpairs(inner, 3, solver="block-lanczos")


@pytest.mark.parametrize(("size", "digits"), [(1e-110, "1e-330"), (1e110, "1e330")])
def test_tensors_without_a_determinant_are_refused_for_their_size(size, digits):
    with pytest.raises(ValueError, match=f"determinant, about {digits}, is beyond the accurate range of float64"):
        hj.TensorField(hj.Grid((3, 3, 3)), size * np.tile(np.eye(3), (3, 3, 3, 1, 1)))
