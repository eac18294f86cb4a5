"""Programs that users compile hold few constants: the compiler reads each of them, and the device keeps a copy."""

import math
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np
import pytest

import hks_jax as hj
from hks_jax.eigen.filter.chebyshev_filter import ChebyshevFilter
from hks_jax.eigen.lanczos.block_lanczos import BlockLanczos
from hks_jax.fem.assembly import assemble

SIDE = 48
FEW = 4096
"""Bytes of what is no larger on finer grids: an element's basis functions, and the like."""


def constants(program: Any) -> Iterator[Any]:
    """Go through the constants of a program and of those within it."""
    yield from getattr(program, "consts", ())
    program = getattr(program, "jaxpr", program)
    for equation in program.eqns:
        yield from (variable.val for variable in equation.invars if hasattr(variable, "val"))
        for value in equation.params.values():
            for inner in value if isinstance(value, tuple | list) else (value,):
                if hasattr(inner, "eqns") or hasattr(inner, "jaxpr"):
                    yield from constants(inner)


def bytes_of_constants(function, shape):
    d = len(shape)
    program = jax.make_jaxpr(function)(np.broadcast_to(np.eye(d), (*shape, d, d)))
    return sum({id(constant): np.asarray(constant).nbytes for constant in constants(program)}.values())


def pairs_by(solver):
    def compute(tensors):
        field = hj.TensorField(hj.Grid(tensors.shape[:-2]), tensors)
        pairs = hj.eigenpairs(field, 4, solver=solver)
        return pairs.eigenvalues, pairs.vectors

    return compute


def test_constants_are_counted_within_programs_too():
    known = np.arange(100.0)
    inner = jax.jit(lambda x: x + known)
    assert bytes_of_constants(lambda x: jax.lax.map(inner, x[0, 0, :, :1])[0], (2, 2)) >= known.nbytes


@pytest.mark.parametrize("shape", [(SIDE, SIDE), (12, 12, 12)])
@pytest.mark.parametrize(("boundary", "of_a_node"), [("neumann", 0), ("periodic", 0), ("dirichlet", 8)])
def test_assembly_has_no_constants_of_the_grids_size_but_which_nodes_are_free(shape, boundary, of_a_node):
    def coefficients(tensors):
        pencil = assemble(hj.TensorField(hj.Grid(shape), tensors), boundary)
        return pencil.stiffness.coefficients, pencil.mass.coefficients

    assert bytes_of_constants(coefficients, shape) < FEW + of_a_node * math.prod(shape)


def test_the_filter_has_no_constants_of_the_grids_size():
    # Colours along an axis, and no more: 36 bytes for each node of all coarse axes.
    assert bytes_of_constants(pairs_by(ChebyshevFilter()), (SIDE, SIDE)) < FEW + 2 * 36 * SIDE


@pytest.mark.slow
def test_block_lanczos_has_nothing_but_the_elimination_tree_for_constants():
    assert bytes_of_constants(pairs_by(BlockLanczos()), (SIDE, SIDE)) < FEW + 80 * SIDE**2


MANY, CUBE = 10_000, (64,) * 3
"""So many vectors on so few nodes have 2.6·10⁹ entries, as 156 vectors on 256³ nodes have; nothing is computed."""


def axes(program: Any) -> Iterator[int]:
    """Go through the lengths of the axes of all arrays in a program."""
    program = getattr(program, "jaxpr", program)
    for equation in program.eqns:
        for variable in (*equation.invars, *equation.outvars):
            yield from getattr(variable.aval, "shape", ())
        for value in equation.params.values():
            for inner in value if isinstance(value, tuple | list) else (value,):
                if hasattr(inner, "eqns") or hasattr(inner, "jaxpr"):
                    yield from axes(inner)


def stored(constant):
    """Return the part of a constant that JAX puts into a program: of values that repeat along an axis, the first."""
    return constant[tuple(slice(1) if stride == 0 else slice(None) for stride in constant.strides)]


def signature_of_many(tensors):
    pairs = hj.eigenpairs(hj.TensorField(hj.Grid(CUBE), tensors), MANY, solver=ChebyshevFilter())
    return hj.hks(pairs, np.array([0.5, 1.0], tensors.dtype))


@pytest.mark.parametrize("derivative", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_arrays_of_more_than_2_to_the_31_entries_are_never_flattened(derivative):
    """JAX's indices along an axis are 32-bit integers unless 64-bit numbers are enabled."""
    function = signature_of_many
    if derivative:
        function = jax.grad(lambda tensors: jax.numpy.sum(signature_of_many(tensors) ** 2))
    with jax.enable_x64(False):
        program = jax.make_jaxpr(function)(jax.ShapeDtypeStruct((*CUBE, 3, 3), np.float32))
    assert max(axes(program)) < 2**31 < MANY * math.prod(CUBE)
    known = [stored(np.asarray(constant)) for constant in constants(program)]
    of_nodes = [constant for constant in known if constant.shape != (MANY, MANY)]
    assert max(constant.nbytes for constant in of_nodes) <= 8 * MANY < math.prod(CUBE)  # not even a mask
