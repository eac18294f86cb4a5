"""The automatic choice of a solver. Under jit, it is a solver on the host only on a single CPU."""

from contextlib import contextmanager
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fields import flat, random_spd

import hks_jax as hj
from hks_jax.eigen import automatic
from hks_jax.eigen.automatic import choose_for_command, choose_for_fit, choose_solver
from hks_jax.eigen.shift_invert.shift_invert import ShiftInvert


def single(pencil):
    """Return a pencil in single precision."""
    return jax.tree.map(lambda x: x.astype(jnp.float32) if x.dtype == np.float64 else x, pencil)


def primitives(jaxpr):
    """Return the names of all primitives in a jaxpr, inner ones included."""
    for equation in jaxpr.eqns:
        yield equation.primitive.name
        for inner in jax.tree.leaves(equation.params, is_leaf=lambda p: hasattr(p, "eqns") or hasattr(p, "jaxpr")):
            if hasattr(inner, "jaxpr"):
                yield from primitives(inner.jaxpr)
            elif hasattr(inner, "eqns"):
                yield from primitives(inner)


def hks_of_grid(tensors, k):
    grid = hj.Grid(tensors.shape[:-2], 0.1)
    pairs = hj.eigenpairs(hj.TensorField(grid, tensors), k)
    return jnp.sum(hj.hks(pairs, [0.1, 1.0])), pairs.solver_name


def hks_of_surface(vertices, k):
    faces = hj.examples.bumpy_torus_mesh(16).faces
    pairs = hj.eigenpairs(hj.SurfaceMesh(vertices, faces), k)
    return jnp.sum(hj.hks(pairs, [0.1, 1.0])), pairs.solver_name


SMALL = 100
"""In place of 1500 unknowns: the same choices on smaller grids."""
CASES = {
    "dense": (hks_of_grid, (9, 10), 5),
    "dense, many pairs": (hks_of_grid, (14, 15), 25),
    "block-lanczos": (hks_of_grid, (14, 15), 12),
    "block-lanczos, surface": (hks_of_surface, None, 5),
    "chebyshev-filter": (hks_of_grid, (8, 7, 6), 5),
    "block-lanczos, 3d, many pairs": (hks_of_grid, (8, 7, 6), 30),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_the_jitted_gradient_of_the_default_has_no_callback_with_several_devices(monkeypatch, name, dtype):
    monkeypatch.setattr(automatic, "_SMALL", SMALL)
    monkeypatch.setattr(jax, "device_count", lambda: 2)
    function, shape, k = CASES[name]
    if shape is None:
        values = hj.examples.bumpy_torus_mesh(16).vertices
    else:
        values = jnp.broadcast_to(jnp.eye(len(shape)), (*shape, len(shape), len(shape)))
    chosen = []

    def loss(values):
        total, solver = function(values, k)
        chosen.append(solver)
        return total

    jaxpr = jax.make_jaxpr(jax.jit(jax.grad(loss)))(values.astype(dtype))
    found = set(primitives(jaxpr.jaxpr))
    assert "mul" in found
    assert not [primitive for primitive in found if "callback" in primitive]
    assert set(chosen) == {name.split(",")[0]}


def test_who_asks_for_shift_invert_gets_it_under_jit():
    def loss(tensors):
        pairs = hj.eigenpairs(hj.TensorField(hj.Grid((6, 5)), tensors), 3, solver="shift-invert")
        return jnp.sum(pairs.eigenvalues)

    jaxpr = jax.make_jaxpr(jax.jit(loss))(jnp.broadcast_to(jnp.eye(2), (6, 5, 2, 2)))
    assert "pure_callback" in set(primitives(jaxpr.jaxpr))


@contextmanager
def programs_in(folder):
    """Let JAX store compiled programs in a folder, or nowhere, as users have it."""
    before = jax.config.values["jax_compilation_cache_dir"]
    jax.config.update("jax_compilation_cache_dir", folder)
    try:
        yield
    finally:
        jax.config.update("jax_compilation_cache_dir", before)


@pytest.mark.parametrize(
    ("shape", "dtype", "adjoint"),
    [
        ((14, 15), jnp.float64, hj.FactorisedAdjoint),
        ((14, 15), jnp.float32, hj.HostAdjoint),
        ((6, 7, 8), jnp.float64, hj.HostAdjoint),
    ],
)
def test_under_jit_on_one_cpu_the_host_computes_the_pairs(monkeypatch, shape, dtype, adjoint):
    monkeypatch.setattr(automatic, "_SMALL", SMALL)
    chosen, grid = [], hj.Grid(shape, 0.1)

    def choose(assemble, tensors):
        chosen.append(choose_solver("auto", assemble(hj.TensorField(grid, tensors)), 5))
        return tensors

    tensors = jnp.broadcast_to(jnp.eye(len(shape), dtype=dtype), (*shape, len(shape), len(shape)))
    with programs_in(None):
        jax.make_jaxpr(partial(choose, hj.assemble))(tensors)
        jax.make_jaxpr(partial(choose, hj.assemble_forms))(tensors)  # without a lower bound, it may leave doubt
    assert (chosen[0].name, type(chosen[0].adjoint)) == ("shift-invert", adjoint)
    assert chosen[1].name != "shift-invert"


def test_programs_that_jax_stores_do_not_call_the_host(tmp_path):
    def chosen(folder):
        def choose(tensors):
            names.append(choose_solver("auto", hj.assemble(hj.TensorField(hj.Grid((42, 41)), tensors)), 5).name)
            return tensors

        names = []
        with programs_in(folder):
            jax.make_jaxpr(choose)(jnp.broadcast_to(jnp.eye(2), (42, 41, 2, 2)))
        return names

    assert chosen(None) == ["shift-invert"]
    assert chosen(str(tmp_path)) == ["block-lanczos"]


@pytest.mark.slow
def test_what_auto_chooses_where_values_are_known():
    plane, volume = hj.assemble(flat((42, 41), (1.0, 1.0))), hj.assemble(flat((12, 12, 13), (1.0, 1.0, 1.0)))
    surface = hj.assemble(hj.examples.bumpy_torus_mesh(50))
    assert choose_solver("auto", plane, 20).name == "shift-invert"
    assert choose_solver("auto", plane, 431).name == "dense"
    assert [choose_solver("auto", volume, k).name for k in (20, 190)] == ["shift-invert"] * 2
    assert choose_solver("auto", hj.assemble(flat((20, 20, 20), (1.0, 1.0, 1.0))), 100).name == "chebyshev-filter"
    assert [choose_solver("auto", surface, k).name for k in (300, 450)] == ["shift-invert", "block-lanczos"]
    large = hj.assemble(flat((130, 130), (1.0, 1.0)))
    assert [choose_solver("auto", large, k).name for k in (40, 50)] == ["shift-invert", "block-lanczos"]


@pytest.mark.slow
def test_what_auto_chooses_in_single_precision():
    plane, volume = (single(hj.assemble(flat(shape, (1.0,) * len(shape)))) for shape in ((130, 130), (20, 20, 20)))
    assert [choose_solver("auto", plane, k).name for k in (290, 300)] == ["shift-invert", "chebyshev-filter"]
    assert choose_solver("auto", volume, 100).name == "chebyshev-filter"


def test_the_problems_of_a_doubled_domain_share_the_pairs(monkeypatch):
    field = hj.TensorField(hj.Grid((42, 41)), np.broadcast_to(np.diag([1.0, 2.0]), (42, 41, 2, 2)))
    monkeypatch.setattr(automatic, "_LARGE", 30 * field.grid.size)
    assert hj.eigenpairs(field, 40, "mean").solver_name == "shift-invert"
    assert choose_solver("auto", hj.assemble(field), 40).name == "block-lanczos"


def test_a_command_takes_shift_invert_for_more_pairs(monkeypatch):
    pencil = hj.assemble(hj.TensorField(hj.Grid((42, 41)), np.broadcast_to(np.diag([1.0, 2.0]), (42, 41, 2, 2))))
    monkeypatch.setattr(automatic, "_LARGE", 30 * pencil.space.n_dof)
    monkeypatch.setattr(automatic, "_LARGE_FOR_COMMAND", 60 * pencil.space.n_dof)
    assert [choose_solver("auto", pencil, k).name for k in (20, 40, 80)] == ["shift-invert", *["block-lanczos"] * 2]
    assert [choose_for_command(pencil, k).name for k in (20, 40, 80)] == [*["shift-invert"] * 2, "block-lanczos"]
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert choose_for_command(pencil, 40).name == "block-lanczos"


@pytest.mark.parametrize("boundary", ["neumann", "mean"])
def test_a_second_solver_follows_if_the_first_leaves_doubt(boundary, rng, monkeypatch):
    """Without a lower bound of the spectrum, shift-invert may fail; each problem of a doubled domain has its own."""
    monkeypatch.setattr(automatic, "_SMALL", 20)
    monkeypatch.setattr(automatic, "BlockLanczos", hj.Dense)  # which compiles nothing
    found = ShiftInvert.lowest
    field = hj.TensorField(hj.Grid((8, 7), mask=np.arange(56).reshape(8, 7) > 1), random_spd(rng, (8, 7), 0.2))
    pencil = hj.assemble_forms(field, boundary=boundary)
    certain = hj.eigenpairs(pencil, 5)
    monkeypatch.setattr(ShiftInvert, "lowest", lambda *args: (*found(*args)[:2], jnp.asarray(jnp.nan)))
    pairs = hj.eigenpairs(pencil, 5)
    assert (certain.solver_name, pairs.solver_name) == ("shift-invert", "dense")
    np.testing.assert_allclose(pairs.eigenvalues, certain.eigenvalues, atol=1e-9)


@pytest.mark.slow
def test_on_accelerators_nothing_runs_on_the_host(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    plane = hj.assemble(flat((42, 41), (1.0, 1.0)))
    assert choose_solver("auto", plane, 20).name == "block-lanczos"
    # Factors in single precision lose too many digits.
    assert choose_solver("auto", single(plane), 20).name == "chebyshev-filter"
    assert choose_solver("auto", hj.assemble(flat((12, 12, 13), (1.0, 1.0, 1.0))), 20).name == "chebyshev-filter"


def test_fits_reuse_factorisations_in_jax(monkeypatch):
    pencil = hj.assemble(flat((42, 41), (1.0, 1.0)))
    with programs_in(None):
        assert [choose_for_fit(pencil, k).name for k in (20, 420)] == ["shift-invert", "dense"]
        assert choose_for_fit(pencil, 20).adjoint == hj.FactorisedAdjoint(1e-5, solves=20)
        monkeypatch.setattr(jax, "device_count", lambda: 2)
        assert choose_for_fit(pencil, 20).name == "block-lanczos"
    assert choose_for_fit(hj.assemble(flat((12, 10), (1.0, 1.0))), 5).name == "dense"
