"""The work of each device, as counts of operations and bytes sent, on 1, 2, 4 and 8 virtual devices.

    python benchmarks/accelerators/devices.py [--nodes 64 48 40] [-o FILE]
    python benchmarks/accelerators/devices.py --large 256/200 256/500 [-o FILE]

Virtual devices share the machine's cores, so that their wall time says nothing. The traced program of a filter round
gives the bytes of collectives, loops multiplied out. One number is a time: node·columns a second of the stencil product
on one device. With ``--large``, volumes are compiled and not computed; the memory of a filter round on each device is
that of XLA's program for CPUs.
"""

import argparse
import os
import sys
from functools import partial
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

# Before JAX starts.
os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=8"
os.environ.setdefault("JAX_PLATFORMS", "cpu")

import jax
import jax.numpy as jnp
import numpy as np
from machine import RESULTS, timed, write

import hks_jax as hj
from hks_jax.eigen.filter.subspace_iteration import FilterState, GridFilter
from hks_jax.fem.halo import Slabs
from hks_jax.fem.nodal import nodal_pencil
from hks_jax.fem.stencil import Stencil

PAIRS, COLUMNS = 90, 16
COLLECTIVES = ("ppermute", "all_to_all", "psum")


def sent(jaxpr: Any, times: int = 1) -> dict[str, int]:
    """Return the bytes that one device hands to each kind of collective: its share, not the traffic of algorithms."""
    found = dict.fromkeys(COLLECTIVES, 0)
    for equation in jaxpr.eqns:
        kind = next((c for c in COLLECTIVES if equation.primitive.name.startswith(c)), None)
        if kind:
            found[kind] += times * sum(x.aval.size * x.aval.dtype.itemsize for x in equation.invars)
        loops = equation.params["length"] if equation.primitive.name == "scan" else 1
        for inner in jax.tree.leaves(list(equation.params.values()), is_leaf=lambda p: hasattr(p, "eqns")):
            inner = getattr(inner, "jaxpr", inner)
            if hasattr(inner, "eqns"):
                below = sent(inner, times * loops)
                # The length of these loops is unknown, and so is their traffic.
                assert equation.primitive.name != "while" or not any(below.values())
                found = {c: found[c] + below[c] for c in COLLECTIVES}
    return found


def filter_round(shape: tuple[int, ...], devices: int, k: int, columns: int) -> tuple[Any, tuple, Any]:
    """Return a filter round, the shapes of its arguments, and the settings of the filter."""
    mesh = jax.make_mesh((devices,), ("devices",), devices=jax.devices()[:devices])
    slabs = Slabs(mesh, shape, (False,) * len(shape))
    struct = partial(jax.ShapeDtypeStruct, dtype=jnp.float32)
    grid = hj.Grid(shape, 1 / (max(shape) - 1))
    pencil = jax.eval_shape(lambda T: hj.assemble(hj.TensorField(grid, T)), struct((*shape, 3, 3)))
    plan = hj.ChebyshevFilter(block=columns, mesh=mesh).plan(k, pencil)
    parts = jax.sharding.NamedSharding(slabs.mesh, jax.sharding.PartitionSpec(None, slabs.name))
    whole = jax.sharding.NamedSharding(slabs.mesh, jax.sharding.PartitionSpec())
    values, count = struct((plan.size,)), jax.ShapeDtypeStruct((), int, sharding=whole)
    vectors = struct((plan.size, int(np.prod(slabs.padded_shape))), sharding=parts)
    state = FilterState(values, vectors, values, values, count, count)
    nodal = jax.eval_shape(nodal_pencil, pencil)
    nodal = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=whole), nodal)
    return GridFilter.improve, (GridFilter(nodal, struct(()), plan), struct(()), state), plan


def counts(shape: tuple[int, ...], devices: int, k: int = PAIRS, columns: int = COLUMNS // 2) -> dict:
    """Return the counts of an inner device of `devices`."""
    others = min(devices - 1, 1)  # to send anything to
    function, arguments, plan = filter_round(shape, devices, k, columns)
    exchanged = sent(jax.make_jaxpr(function)(*arguments).jaxpr)
    return {
        "devices": devices,
        "filter_round": {
            "vectors": plan.size,
            "vectors_filtered": plan.size // devices,
            "vector_bytes": arguments[2].vectors.size * 4 // devices,
            "all_to_all_bytes": exchanged["all_to_all"] * (devices - 1) // devices,
            "halo_bytes": others * exchanged["ppermute"],
            "sum_bytes": others * exchanged["psum"],
        },
    }


def large(n: int, k: int, devices: int = 8) -> dict:
    """Return the counts for a device and its memory in a filter round on n³ nodes, in GB."""
    found = counts((n,) * 3, devices, k + 1)["filter_round"]
    function, arguments, _ = filter_round((n,) * 3, devices, k + 1, COLUMNS // 2)
    memory = function.lower(*arguments).compile().memory_analysis()
    arrays = memory.argument_size_in_bytes + memory.output_size_in_bytes - memory.alias_size_in_bytes
    row = {"nodes": n**3, "k": k, "devices": devices, "vectors": found["vectors"]}
    row |= {"vectors_filtered": found["vectors_filtered"], "stored_GB": found["vector_bytes"] / 1e9}
    row |= {f"{name}_GB": found[f"{name}_bytes"] / 1e9 for name in ("all_to_all", "halo", "sum")}
    return row | {"peak_GB": (arrays + memory.temp_size_in_bytes) / 1e9}


def speed(dtype: Any) -> float:
    """Return node·columns a second of one stencil product in 3D, on one device of all cores."""
    shape, steps = (64, 64, 64), 10
    c, x = jnp.full((27, *shape), 1 / 27, dtype), jnp.ones((*shape, COLUMNS), dtype)

    def many(c: jax.Array, x: jax.Array) -> jax.Array:
        return jax.lax.fori_loop(0, steps, lambda _, y: Stencil(c, (False,) * 3) @ y, x)

    return steps * x.size / timed(jax.jit(many), c, x, repeats=20)[0]


def main() -> None:
    """Count, print a table, and write the result file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--nodes", type=int, nargs=3, default=(64, 48, 40), help="along each axis")
    parser.add_argument("--large", nargs="+", metavar="N/K", help="N³ nodes, K pairs, on eight devices")
    parser.add_argument("-o", "--output", type=Path)
    arguments = parser.parse_args()
    if arguments.large:
        volumes = [large(*map(int, case.split("/"))) for case in arguments.large]
        print(*volumes, sep="\n")
        note = "a filter round was compiled for eight virtual devices; no program ran"
        write(arguments.output or RESULTS / "devices_large.json", volumes, columns=COLUMNS // 2, note=note)
        return
    shape = tuple(arguments.nodes)
    speeds = {"float32": speed(jnp.float32)}
    with jax.enable_x64(True):
        speeds["float64"] = speed(jnp.float64)
    rows = [counts(shape, devices) for devices in (1, 2, 4, 8)]
    print("devices | vectors, MB dealt, kB halo, kB summed")
    for row in rows:
        filtered = row["filter_round"]
        print(
            f"{row['devices']:7d} | {filtered['vectors_filtered']:4d} {filtered['all_to_all_bytes'] / 1e6:8.2f} "
            f"{filtered['halo_bytes'] / 1e3:8.1f} {filtered['sum_bytes'] / 1e3:8.1f}"
        )
    print({name: f"{value:.2g} node·columns/s" for name, value in speeds.items()})
    output, about = arguments.output or RESULTS / "devices.json", {"columns": COLUMNS, "dtype": "float32"}
    write(output, rows, nodes=shape, **about, node_columns_per_second=speeds)


if __name__ == "__main__":
    main()
