"""The memory of each stage of a volume on a GPU, from fields to signatures, compiled without there being one.

    python benchmarks/accelerators/stages.py [--cases 96/200 ...] [--stages NAME ...] [-o FILE]

XLA compiles each program that the Chebyshev filter, its residuals and the signature launch outside of `jit`, in
float32, for an NVIDIA H200 (see launches.py). Nothing is computed, and no array is made. The peak of a stage is that of
its program (arguments, results and temporaries) plus the arrays that live on beside it. A stage that is in the file
already is not compiled again.
"""

import argparse
import json
import os
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

os.environ.setdefault("JAX_PLATFORMS", "cpu")  # nothing may run on a GPU that is at hand

import jax
import jax.numpy as jnp
import numpy as np
from compiled import Program, compile_for_chip, peak_bytes, unavailable
from machine import RESULTS, write

import hks_jax as hj
from hks_jax.eigen.derivative import _cut, _with_null_modes
from hks_jax.eigen.eigenpairs import PencilEigenpairs
from hks_jax.eigen.filter.chebyshev_filter import _wanted
from hks_jax.eigen.filter.coarsening import coarsen
from hks_jax.eigen.filter.subspace_iteration import FilterState, GridFilter
from hks_jax.eigen.one_pencil import _quality
from hks_jax.fem.nodal import nodal_pencil
from hks_jax.linear import accelerators
from hks_jax.signatures.contractions import Diagonal

CASES = ("96/200", "128/200", "128/500", "192/200", "256/100", "256/200", "256/500")
GRADIENT = "128/200"
TIMES = 8
Stage = tuple[str, Callable, tuple, Any]
"""The name of a stage, its function, its arguments, and further arrays that live beside it."""


def array(*shape: int, dtype: Any = np.float32) -> jax.ShapeDtypeStruct:
    """Return the description of an array."""
    return jax.ShapeDtypeStruct(shape, dtype)


def field_of(n: int) -> Callable[[jax.Array], hj.TensorField]:
    """Return the function from tensors to a field of n³ nodes on the unit cube."""
    return partial(hj.TensorField, hj.Grid((n,) * 3, 1 / (n - 1)))


def state_of(plan: Any, n_nodes: int) -> FilterState:
    """Return the description of the filter's state."""
    m, number = plan.size, array(dtype=jnp.int32)
    return FilterState(array(m), array(m, n_nodes), array(m), array(m), number, number)


def stages(n: int, k: int) -> Iterator[Stage]:
    """Yield the stages of k eigenpairs on n³ nodes, in their order."""
    field, tensors, nodes = field_of(n), array(n, n, n, 3, 3), n**3
    pencil = jax.eval_shape(lambda T: hj.assemble(field(T)), tensors)
    nodal = jax.eval_shape(nodal_pencil, pencil)
    matrices = pencil.stiffness, pencil.mass
    own = tensors, pencil.metric, pencil.null_space, nodal.lumped, nodal.free, nodal.domain  # beside K and M
    one, plan = array(), hj.ChebyshevFilter().plan(k + 1, pencil)
    coarse = jax.eval_shape(coarsen, nodal)
    fine, next_to = GridFilter(nodal, one, plan), GridFilter(coarse, one, plan)
    state = state_of(plan, nodes)
    vectors, kept = array(k + 1, nodes), array(k, nodes)

    def quality(pencil: Any, vectors: Any, values: Any, following: Any) -> Any:
        return _quality(pencil, vectors, values, following, None, 1, 1e-8, True, False)

    def errors(pencil: Any, values: Any, times: Any) -> Any:
        flags, nothing = jnp.ones(k, bool), jnp.zeros(())
        pairs = PencilEigenpairs(
            values, values, flags, values, flags, values[-1], nothing, nothing, nothing, jnp.zeros((k, 0)), pencil, ""
        )
        return hj.truncation(pairs, times)

    yield "assembly", lambda T: hj.assemble(field(T)), (tensors,), ()
    yield "coarser grid", coarsen, (nodal,), own[:3]
    yield "start", GridFilter.from_coarse, (fine, next_to, state_of(plan, coarse.free.size)), (own[:3], coarse)
    yield "round", GridFilter.improve, (fine, one, state), (own[:3], coarse)
    wanted = partial(_wanted, returned=k + 1)
    yield "wanted pairs", wanted, (fine, state), (own, matrices, coarse)
    of_nulls = pencil.mass, array(1, nodes), array(k + 1), vectors
    yield "null vectors", _with_null_modes, of_nulls, (own, pencil.stiffness)
    yield "first k", lambda values, vectors: _cut(values, vectors, k), (array(k + 1), vectors), (own, matrices)
    yield "residuals", quality, (pencil, kept, array(k), one), tensors
    yield "errors", errors, (pencil, array(k), array(TIMES)), (tensors, kept)
    yield "signature", Diagonal().weighted, (array(TIMES, k), kept), (own, matrices)
    if f"{n}/{k}" == GRADIENT:

        def loss(T: jax.Array) -> jax.Array:
            pairs = hj.eigenpairs(field(T), k, solver="chebyshev-filter")
            return jnp.sum(jnp.log(hj.hks(pairs, np.array([1e-2, 1e-1], np.float32))))

        yield "gradient", jax.value_and_grad(loss), (tensors,), ()


def size(tree: Any) -> int:
    """Return the bytes of all arrays of a pytree."""
    return sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(tree))


def measured(what: str, n: int, k: int, function: Callable, arguments: tuple, beside: Any) -> dict:
    """Return a row of the table."""
    compiled = compile_for_chip(function, *arguments)
    cost, memory = Program(compiled).cost(), compiled.memory_analysis()
    return {
        "what": what,
        "nodes": n**3,
        "k": k,
        "peak_GB": round((peak_bytes(compiled) + size(beside)) / 1e9, 2),
        "arguments_GB": round(memory.argument_size_in_bytes / 1e9, 2),
        "temporary_GB": round(memory.temp_size_in_bytes / 1e9, 2),
        "beside_GB": round(size(beside) / 1e9, 2),
        "launches": round(cost.launches),
        "waits": round(cost.waits),
    }


def main() -> None:
    """Compile, print a table, and write the result file after each stage."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", nargs="+", default=CASES, metavar="N/K", help="N³ nodes, K pairs")
    parser.add_argument("--stages", nargs="*", metavar="NAME", help="such as 'round'")
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "stages.json")
    arguments = parser.parse_args()
    if reason := unavailable():
        print(reason)
        return
    accelerators.at_hand = lambda: True  # as if there were a GPU here
    rows = json.loads(arguments.output.read_text())["rows"] if arguments.output.exists() else []
    for case in arguments.cases:
        n, k = map(int, case.split("/"))
        known = {row["what"] for row in rows if (row["nodes"], row["k"]) == (n**3, k)}
        for name, *stage in stages(n, k):
            if name not in known and (not arguments.stages or name in arguments.stages):
                rows.append(measured(name, n, k, *stage))
                print(rows[-1], flush=True)
                note = "compiled on this machine for an NVIDIA H200 from its description; no program ran"
                write(
                    arguments.output, sorted(rows, key=lambda row: (row["nodes"], row["k"])), dtype="float32", note=note
                )


if __name__ == "__main__":
    main()
