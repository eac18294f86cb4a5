"""What differs in numbers only, or in whom progress is told, is not compiled anew."""

from collections.abc import Iterator
from contextlib import contextmanager

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fields import random_spd

import hks_jax as hj


@contextmanager
def compilations() -> Iterator[list[str]]:
    """Collect what JAX hands to the compiler; also what its cache on disk has."""
    seen = []

    def listen(event, seconds, **about):
        if event == "/jax/core/compile/backend_compile_duration":
            seen.append(about.get("fun_name", "?"))

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield seen
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)


SOLVERS = {
    "dense": ("dense", (9, 10), "neumann"),
    "dense, mirror": ("dense", (9, 10), ("mirror", "neumann")),
    "dense, 3d": ("dense", (5, 4, 6), "periodic"),
    "block-lanczos": (hj.BlockLanczos(block=2), (9, 10), "neumann"),
    "chebyshev-filter": (hj.ChebyshevFilter(block=4), (14, 13), ("periodic", "dirichlet")),
}
CASES = [
    pytest.param(name, gradient, marks=() if name == "dense" else pytest.mark.slow)
    for name in SOLVERS
    for gradient in (False, True)
]


@pytest.mark.filterwarnings("ignore::hks_jax.AccuracyWarning")  # of so few pairs
@pytest.mark.parametrize(("name", "gradient"), CASES)
def test_spacing_origin_values_and_progress_compile_nothing_anew(rng, name, gradient):
    solver, shape, boundary = SOLVERS[name]
    told = []

    def loss(tensors, grid, scale):
        field = hj.TensorField(grid, tensors)
        pairs = hj.eigenpairs(field, 4, boundary, solver, progress=lambda text: told.append(text))
        return jnp.nansum(hj.hks(pairs, np.array([0.5, 2.0]) * scale))

    def run(spacing, origin):
        mask = np.arange(np.prod(shape)).reshape(shape) > 0
        grid = hj.Grid(shape, spacing, origin, mask)
        tensors = jnp.asarray(random_spd(rng, shape))
        return (jax.grad(loss) if gradient else loss)(tensors, grid, np.mean(spacing) ** 2)

    run(1.0, 0.0)
    with compilations() as seen:
        run((0.5, 0.7, 0.6)[: len(shape)], (3.0, -1.0, 0.0)[: len(shape)])
    assert not seen


@pytest.mark.slow
@pytest.mark.parametrize("solver", [hj.ChebyshevFilter(block=4), hj.BlockLanczos(block=4), "shift-invert"])
def test_what_is_compiled_for_one_mask_serves_another(rng, solver):
    def run(missing, gradient):
        mask = np.zeros((50, 49), bool)
        mask[10:40, 8:37] = True
        mask[10:40, 8:37][missing] = False
        tensors = jnp.asarray(random_spd(rng, mask.shape))

        def loss(tensors):
            field = hj.TensorField(hj.Grid(mask.shape, mask=mask), tensors)
            return jnp.nansum(hj.hks(hj.eigenpairs(field, 4, "mean", solver), np.array([300.0])))

        return jax.grad(loss)(tensors) if gradient else loss(tensors)

    first, second, third = np.s_[0, 0], np.s_[10:13, 10:14], np.s_[20:, 25:]
    for gradient in (False, True):
        run(first, gradient)
        run(second, gradient)  # other accuracies of factorisations have programs of their own
        with compilations() as seen:
            run(third, gradient)
        # Only the numbers of unknowns differ: rows go from the box to the nodes of a mask, where signatures are sums.
        moves = {"jit(taken)", "jit(_spread)", "jit(broadcast_in_dim)"} if gradient else set()
        assert set(seen) <= moves | {"jit(stage)", "jit(_weighted)"}


def test_matrices_scale_with_the_spacing(rng):
    """A coordinate in other units is the same metric in other components."""
    shape, h = (6, 5), np.array([0.3, 0.2])
    tensors = random_spd(rng, shape)
    fine = hj.assemble(hj.TensorField(hj.Grid(shape, h, (1.0, 2.0)), tensors))
    with compilations() as seen:
        unit = hj.assemble(hj.TensorField(hj.Grid(shape), tensors * h[:, None] * h))
    assert not seen
    for ours, other in ((fine.stiffness, unit.stiffness), (fine.mass, unit.mass)):
        np.testing.assert_allclose(ours.to_dense(), other.to_dense(), atol=1e-13)
    np.testing.assert_allclose(fine.resolution.mesh_width, unit.resolution.mesh_width, rtol=1e-13)
    assert fine.space == unit.space
    assert hash(fine.space) == hash(unit.space)


def test_grids_that_differ_are_still_told_apart_under_jit():
    area = jax.jit(lambda field: jnp.prod(jnp.asarray(field.grid.spacing)) * hj.assemble(field).volume)
    for spacing in (0.5, 0.25):
        grid = hj.Grid((3, 3), spacing)
        assert area(hj.TensorField(grid, np.broadcast_to(np.eye(2), (3, 3, 2, 2)))) == pytest.approx(4 * spacing**4)


@pytest.mark.slow
@pytest.mark.parametrize("optimiser", ["gauss-newton", "lbfgs"])
def test_tolerances_of_fits_compile_nothing_anew(optimiser):
    grid = hj.Grid((5, 6), 0.2)
    flat = hj.TensorField(grid, np.broadcast_to(np.eye(2), (5, 6, 2, 2)))
    field = hj.TensorField(grid, np.exp(0.3 * grid.nodes[..., :1])[..., None] * np.eye(2))
    times = np.geomspace(0.05, 0.5, 3)
    target = np.asarray(hj.hks(hj.eigenpairs(field, 30), times))

    def fit(tolerance):
        return hj.fit_metric(
            flat, target, times, "conformal", k=30, search=hj.inverse.Search(optimiser=optimiser, tolerance=tolerance)
        )

    with compilations() as seen:
        rough = fit(1e-1)
    assert sum("_advance" in name for name in seen) == 1  # for the first step and all others
    with compilations() as seen:
        fine = fit(1e-5)
    assert not seen
    assert len(fine.history) > len(rough.history)


@pytest.mark.slow
def test_all_slices_are_one_compilation(rng):
    pencil = hj.assemble(hj.TensorField(hj.Grid((21, 22)), random_spd(rng, (21, 22))))
    told = []
    with compilations() as seen:
        hj.BlockLanczos(slice_size=20).lowest(pencil, 70, told.append)
    assert len(told) > 2
    assert sum("_advance" in name for name in seen) == 1
    assert len(seen) == len(set(seen)), sorted(seen)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::hks_jax.AccuracyWarning")  # of so few pairs
def test_plain_derivatives_use_the_solver_as_it_was_compiled(rng):
    grid, solver = hj.Grid((9, 11)), hj.BlockLanczos(block=2)
    tensors = jnp.asarray(random_spd(rng, grid.shape))
    solver.lowest(hj.assemble(hj.TensorField(grid, tensors)), 4 + solver.guards(4, 99))
    with compilations() as seen:
        jax.grad(lambda x: hj.hks(hj.eigenpairs(hj.TensorField(grid, x), 4, solver=solver), [0.5]).sum())(tensors)
    assert seen
    assert not any("_eliminate" in name or "_advance" in name for name in seen), seen
