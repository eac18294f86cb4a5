"""The work of a GPU, estimated: kernel launches, waits of the host and peak memory of the programs that XLA makes.

    python benchmarks/accelerators/launches.py [--only NAME ...] [--before FILE] [-o FILE]

XLA compiles for an NVIDIA H200 without there being one; nothing runs. Needs the wheels of ``pip install "jax[cuda13]"``
in an environment of its own, and says so without them. The least time is for each kernel the longest of 4 µs for its
launch, of its bytes at 4.8 TB/s and of its products at 34 TFLOP/s (float32: 67): an estimate from compiled code, and a
lower bound as far as kernels and libraries do not take longer. ``--before`` keeps beside each number that of another
result file, of a version before.
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

os.environ.setdefault("JAX_PLATFORMS", "cpu")  # arrays are computed on the CPU, also beside a GPU

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

jax.config.update("jax_enable_x64", True)

from compiled import Program, compile_for_chip, peak_bytes, unavailable  # noqa: E402
from machine import RESULTS, write  # noqa: E402

import hks_jax as hj  # noqa: E402
from hks_jax.eigen.filter.subspace_iteration import FilterState, GridFilter  # noqa: E402
from hks_jax.eigen.lanczos import recurrence, slicing  # noqa: E402
from hks_jax.eigen.lanczos.block_lanczos import expected  # noqa: E402
from hks_jax.eigen.lanczos.slicing import first_state, make_room  # noqa: E402
from hks_jax.fem.nodal import nodal_pencil  # noqa: E402
from hks_jax.fem.pencil import Pencil  # noqa: E402
from hks_jax.inverse import Data, optimise  # noqa: E402
from hks_jax.inverse.conformal import smoothing  # noqa: E402
from hks_jax.inverse.gauss_newton import GaussNewton  # noqa: E402
from hks_jax.inverse.observation import observe  # noqa: E402
from hks_jax.inverse.problem import Problem  # noqa: E402
from hks_jax.inverse.unknowns import flat_field, unknowns_for  # noqa: E402
from hks_jax.linear import accelerators  # noqa: E402
from hks_jax.linear.dissection import dissect  # noqa: E402
from hks_jax.linear.multifrontal import _eliminate, factorise, try_out  # noqa: E402

accelerators.at_hand = lambda: True  # as if there were a GPU here

GRIDS = ((256, 500), (1024, 500))
VOLUMES = ((64, 200), (128, 500), (256, 500))
COLUMNS = ("launches", "waits", "peak_GB", "least_ms")
Task = tuple[str, str, int, Callable[[], tuple]]
"""The compiled functions by name, with nodes and numbers of pairs, and how to get each with its arguments."""


def shapes_of(n: int, d: int, dtype: type) -> Pencil:
    """Return the pencil of n^d nodes, without its numbers."""
    grid = hj.Grid((n,) * d, 1 / (n - 1))
    tensors = jax.ShapeDtypeStruct((n,) * d + (d, d), dtype)
    return jax.eval_shape(lambda T: hj.assemble(hj.TensorField(grid, T)), tensors)


def lanczos(n: int, k: int) -> Iterator[Task]:
    """Yield the parts of block Lanczos on n² nodes."""
    pencil = shapes_of(n, 2, np.float64)
    plan = hj.BlockLanczos().plan(k, pencil.space.n_null)
    dissection = dissect(pencil.pattern)
    problem = jax.eval_shape(lambda p: expected(p, plan), pencil)
    state, stored = jax.eval_shape(lambda p: first_state(p, plan), problem)
    shift = state.shift
    entries = jax.eval_shape(lambda p, s: p.shifted(s), pencil, shift)
    factor = jax.eval_shape(factorise, dissection, entries)
    negative = jax.eval_shape(lambda f: f.negative, factor)
    known = jax.ShapeDtypeStruct((plan.window, pencil.size), np.float64)
    begin = partial(recurrence._begin, room=plan.steps)
    going = jax.eval_shape(begin, pencil, state.start, known)
    nodes = f"{n}²"

    trial = jax.eval_shape(try_out, factor, pencil, shift, state.noise)

    def look(problem: Any, state: Any, stored: Any) -> Any:
        return slicing._window(problem, plan, state, stored, plan.window)

    window = jax.eval_shape(look, problem, state, stored)
    ritz = (
        jax.ShapeDtypeStruct((plan.ritz,), np.float64),
        jax.ShapeDtypeStruct((plan.ritz, pencil.size), np.float64),
    )

    def consider(problem: Any, negative: Any, trial: Any, state: Any) -> Any:
        return slicing._consider(problem, negative, trial, plan, state)

    def accept(problem: Any, ritz: Any, interval: Any, state: Any) -> Any:
        return slicing._accept(problem, plan, ritz, interval, state)

    def steps(pencil: Any, factor: Any, shift: Any, going: Any, first: Any) -> Any:
        shifted = recurrence.ShiftedSolve(factor, shift, None)
        return recurrence._advance(pencil, shifted, going, plan.window, True, first, first + 2)

    yield "factorisation", nodes, k, lambda: (_eliminate, (dissection, entries, None))
    yield "two Lanczos steps", nodes, k, lambda: (jax.jit(steps, donate_argnums=3), (pencil, factor, shift, going, 0))
    yield (
        "Ritz pairs",
        nodes,
        k,
        lambda: (
            lambda going, steps: recurrence._ritz_pairs(going, plan.window, steps, plan.ritz),
            (going, plan.steps),
        ),
    )
    yield "making room", nodes, k, lambda: (jax.jit(partial(make_room, plan), donate_argnums=1), (state, stored))
    yield "trial of it", nodes, k, lambda: (try_out, (factor, pencil, shift, state.noise))
    yield "decisions", nodes, k, lambda: (consider, (problem, negative, trial, state))
    yield "window", nodes, k, lambda: (look, (problem, state, stored))
    yield "first block", nodes, k, lambda: (begin, (pencil, state.start, known))
    yield "acceptance", nodes, k, lambda: (accept, (problem, ritz, window[1], state))
    order = jax.ShapeDtypeStruct((plan.ritz,), int)
    store = jax.jit(slicing._stored, donate_argnums=0)
    yield "storing", nodes, k, lambda: (store, (stored, ritz[1], order, state.known))


def whole(rows: list[dict], n: int, k: int) -> Iterator[dict]:
    """Yield rows for a slice, and for all pairs: as many slices as are planned, and one factorisation more.

    They are the sums of the steps that the solver, called plainly, takes one after another.
    """
    plan = hj.BlockLanczos().plan(k, 1)
    parts = {row["what"]: row for row in rows if (row["nodes"], row["k"]) == (f"{n}²", k)}
    of_cut = dict.fromkeys(("factorisation", "trial of it", "decisions"), 1)
    of_search = dict.fromkeys(("window", "first block", "Ritz pairs", "acceptance", "storing"), 1)
    of_search["two Lanczos steps"] = plan.steps // 2
    if not parts.keys() >= of_cut.keys() | of_search.keys():
        return
    slices = plan.max_slices // 3 - 4
    for what, cuts, searches in (("a slice", 1, 1), ("all pairs", slices + 1, slices)):
        times = {name: cuts * t for name, t in of_cut.items()} | {name: searches * t for name, t in of_search.items()}
        row: dict[str, Any] = {"what": what, "nodes": f"{n}²", "k": k}
        for column in ("launches", "waits", "least_ms"):
            row[column] = round(sum(t * parts[name][column] for name, t in times.items()), 3)
        row["peak_GB"] = max(parts[name]["peak_GB"] for name in times)
        yield row


def chebyshev_filter(n: int, k: int) -> Iterator[Task]:
    """Yield a round of the filter on n³ nodes."""
    pencil = shapes_of(n, 3, np.float32)
    plan = hj.ChebyshevFilter().plan(k, pencil)
    nodal = jax.eval_shape(nodal_pencil, pencil)

    def array(*shape: int, dtype: type = np.float32) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(shape, dtype)

    m, count = plan.size, array(dtype=np.int64)
    state = FilterState(array(m), array(m, n**3), array(m), array(m), count, count)
    run = jax.jit(GridFilter.improve, donate_argnums=2)
    yield "filter, a round", f"{n}³", k, lambda: (run, (GridFilter(nodal, array(), plan), array(), state))


def derivatives(n: int, k: int) -> Iterator[Task]:
    """Yield the gradient of a loss on the HKS, and a step of a fit, on n² nodes."""
    grid = hj.Grid((n, n), 1 / (n - 1))
    tensors = jax.ShapeDtypeStruct((n, n, 2, 2), np.float64)
    times = np.array([1e-2, 3e-2, 1e-1])

    def loss(tensors: jax.Array) -> jax.Array:
        pairs = hj.eigenpairs(hj.TensorField(grid, tensors), k, solver="block-lanczos")
        return jnp.sum(jnp.log(hj.hks(pairs, times)))

    yield "gradient of the HKS", f"{n}²", k, lambda: (jax.value_and_grad(loss), (tensors,))

    def fit_step() -> tuple:
        flat = flat_field(grid)
        space, dtype = hj.assemble(flat).space, np.dtype(float)
        unknowns = unknowns_for("log-euclidean", flat, space)
        observation, _ = observe(np.ones((3, n, n)), times, Data(), space, dtype)
        problem = Problem(unknowns, observation, (), k, "neumann", "block-lanczos")
        method = GaussNewton(1e-4, 1e-4, 10.0, smoothing(unknowns, 0.1))
        values = unknowns.start()
        state = optimise._begin(method, optimise._residuals, values, problem)
        taken = method, optimise._residuals, values, problem, state, jnp.zeros((), dtype)
        arrays, rest = eqx.partition(taken, eqx.is_array)
        return lambda arrays: eqx.filter(optimise._advance(*eqx.combine(arrays, rest)), eqx.is_array), (arrays,)

    yield "step of a fit", f"{n}²", k, fit_step


def tasks() -> Iterator[Task]:
    """Yield everything that is compiled."""
    for n, k in GRIDS:
        yield from lanczos(n, k)
    for n, k in VOLUMES:
        yield from chebyshev_filter(n, k)
    yield from derivatives(64, 50)


def count(name: str, nodes: str, k: int, build: Callable[[], tuple]) -> dict:
    """Return a row of the table."""
    function, arguments = build()
    compiled = compile_for_chip(function, *arguments)
    cost = Program(compiled).cost()
    return {
        "what": name,
        "nodes": nodes,
        "k": k,
        "launches": round(cost.launches),
        "waits": round(cost.waits),
        "peak_GB": round(peak_bytes(compiled) / 1e9, 3),
        "least_ms": round(1e3 * cost.seconds, 3),
        "libraries": {library: round(times) for library, times in sorted(cost.libraries.items())},
    }


def main() -> None:
    """Compile, count, and write the result file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="*", metavar="NAME", help="such as 'factorisation'")
    parser.add_argument("--before", type=Path, metavar="FILE", help="results of a version before")
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "launches.json")
    arguments = parser.parse_args()
    reason = unavailable()
    if reason:
        print(reason)
        return
    before = {}
    if arguments.before:
        rows = json.loads(arguments.before.read_text())["rows"]
        before = {(row["what"], row["nodes"], row["k"]): row for row in rows}
    rows: list[dict] = []

    def keep(row: dict) -> None:
        print({key: value for key, value in row.items() if key != "libraries"}, flush=True)
        old = before.get((row["what"], row["nodes"], row["k"]), {})
        rows.append(row | {f"{key}_before": old[key] for key in COLUMNS if key in old})
        note = "compiled on this machine for an NVIDIA H200 from its description; no program ran"
        write(arguments.output, rows, note=note)

    for task in tasks():
        if not arguments.only or task[0] in arguments.only:
            keep(count(*task))
    for n, k in GRIDS:
        for row in whole(rows, n, k):
            keep(row)


if __name__ == "__main__":
    main()
