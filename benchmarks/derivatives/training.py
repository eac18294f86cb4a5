"""Steps of training: a batch of fields from a small network, the loss on their signatures, and its gradient.

    python benchmarks/derivatives/training.py [--fields 8] [--nodes 64] [--pairs 50] [--solvers auto …] [-o FILE]

Each row is one solver in float32 or float64: the first step, which compiles, and the later ones, which do not.
Beside them stands the same step with the fields one after another (`jax.lax.map`) in place of `jax.vmap`. The result
file holds seconds, seconds of all processors together, the accuracy of the gradient, and the machine. It needs optax.
"""

import argparse
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from machine import RESULTS, write

import hks_jax as hj

TIMES = (0.005, 0.02, 0.08)


class Network(eqx.Module):
    """A map from a latent code and a point to an SPD tensor, exp of a symmetric matrix."""

    layers: eqx.nn.MLP

    def __init__(self, code: int, key: jax.Array):
        self.layers = eqx.nn.MLP(code + 2, 3, width_size=64, depth=3, activation=jnp.tanh, key=key)

    def __call__(self, code: jax.Array, nodes: jax.Array) -> jax.Array:
        """Return tensors (…, 2, 2) at nodes (…, 2)."""
        points = nodes.reshape(-1, 2)
        a, b, c = jax.vmap(lambda x: self.layers(jnp.concatenate([code, x])))(points).T
        # The exponential of [[a + b, c], [c, a − b]], in closed form.
        size = jnp.sqrt(b * b + c * c + 1e-12)
        even, odd = jnp.cosh(size), jnp.sinh(size) / size
        tensors = jnp.exp(a)[:, None, None] * jnp.stack([even + odd * b, odd * c, odd * c, even - odd * b], -1).reshape(
            -1, 2, 2
        )
        return tensors.reshape(*nodes.shape[:-1], 2, 2)


def training(fields: int, n: int, k: int, solver: str, one_by_one: bool) -> tuple[Callable, Callable, tuple]:
    """Return a step of Adam, the loss, and their first arguments."""
    grid, dtype = hj.Grid((n, n), 1 / (n - 1)), jnp.result_type(float)
    nodes, times = jnp.asarray(grid.nodes, dtype), jnp.asarray(TIMES, dtype)
    keys = jax.random.split(jax.random.key(0), 3)
    codes = jax.random.normal(keys[0], (fields, 8), dtype)

    def signature(network: Network, code: jax.Array) -> jax.Array:
        pairs = hj.eigenpairs(hj.TensorField(grid, network(code, nodes)), k, solver=solver)
        return jnp.log(4 * jnp.pi * times[:, None, None] * hj.hks(pairs, times))

    def signatures(network: Network) -> jax.Array:
        each = lambda code: signature(network, code)  # noqa: E731
        return jax.lax.map(each, codes) if one_by_one else jax.vmap(each)(codes)

    targets = eqx.filter_jit(signatures)(Network(8, keys[1]))
    optimiser = optax.adam(1e-3)
    network = Network(8, keys[2])
    arrays, static = eqx.partition(network, eqx.is_array)

    def loss(arrays: Network) -> jax.Array:
        return jnp.mean((signatures(eqx.combine(arrays, static)) - targets) ** 2)

    @jax.jit
    def step(arrays: Network, state: optax.OptState) -> tuple[Network, optax.OptState, jax.Array]:
        value, gradient = jax.value_and_grad(loss)(arrays)
        updates, state = optimiser.update(gradient, state)
        return eqx.apply_updates(arrays, updates), state, value

    return step, loss, (arrays, optimiser.init(arrays))


def gradient_error(loss: Callable, arrays: Network) -> float:
    """Return the relative difference of a directional derivative from a central difference of fourth order."""
    leaves, structure = jax.tree.flatten(arrays)
    rng = np.random.default_rng(0)
    direction = jax.tree.unflatten(structure, [jnp.asarray(rng.standard_normal(x.shape), x.dtype) for x in leaves])
    value = jax.jit(loss)
    exact = jax.jvp(loss, (arrays,), (direction,))[1]
    size = 1e-5

    def difference(size: float) -> jax.Array:
        upper, lower = (value(jax.tree.map(lambda x, d, h=h: x + h * d, arrays, direction)) for h in (size, -size))
        return (upper - lower) / (2 * size)

    return float(abs((4 * difference(size) - difference(2 * size)) / 3 - exact) / abs(exact))


def measure(fields: int, n: int, k: int, solver: str, one_by_one: bool, steps: int) -> dict:
    """Measure one way, and print its row."""
    step, loss, state = training(fields, n, k, solver, one_by_one)
    seconds, processor = [], []
    for _ in range(steps + 1):
        start, busy = time.perf_counter(), time.process_time()
        *state, value = jax.block_until_ready(step(*state))
        seconds.append(time.perf_counter() - start)
        processor.append(time.process_time() - busy)
    row = {
        "solver": solver,
        "dtype": str(value.dtype),
        "way": "lax.map" if one_by_one else "vmap",
        "first_step_s": seconds[0],
        "step_s": min(seconds[1:]),
        "processor_s": min(processor[1:]),
        "steps_per_second": 1 / min(seconds[1:]),
        # Differences in single precision would measure their own rounding.
        "gradient_error": gradient_error(loss, state[0]) if value.dtype == np.float64 else None,
    }
    print(
        f"{solver:17s} {row['dtype']} {row['way']:8s} first {row['first_step_s']:6.1f} s, then {row['step_s']:6.2f} s "
        f"({row['processor_s']:.2f} s of processors), gradient {row['gradient_error']}",
        flush=True,
    )
    return row


def main() -> None:
    """Measure, print a table, and write the result file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--fields", type=int, default=8)
    parser.add_argument("--nodes", type=int, default=64, help="along each axis")
    parser.add_argument("--pairs", type=int, default=50)
    parser.add_argument("--steps", type=int, default=3)
    parser.add_argument("--solvers", nargs="+", default=["auto", "block-lanczos", "chebyshev-filter"])
    parser.add_argument("--dtypes", nargs="+", default=["float64", "float32"], choices=["float64", "float32"])
    parser.add_argument("--ways", nargs="+", default=["vmap", "lax.map"], choices=["vmap", "lax.map"])
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "training.json")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", hj.AccuracyWarning)
    rows = []
    for dtype in arguments.dtypes:
        jax.config.update("jax_enable_x64", dtype == "float64")
        for solver in arguments.solvers:
            for way in arguments.ways:
                size = arguments.fields, arguments.nodes, arguments.pairs
                rows.append(measure(*size, solver, way == "lax.map", arguments.steps))
    sizes = {"fields": arguments.fields, "nodes": arguments.nodes**2, "k": arguments.pairs}
    write(arguments.output, rows, **sizes, times=list(TIMES))


if __name__ == "__main__":
    main()
