"""Heat kernel signatures without eigenpairs: time and error beside 500 pairs, small times in 3D, gradients.

    python benchmarks/spectrum_free/spectrum_free.py [--cases small agree inversion gradient volume] [-o FILE]

``agree``: 256² nodes, a smooth field of eigenvalues 0.8 and 1.25, at a time that 500 pairs resolve to 1e-8 (selected
inversion) and one that they resolve to 1e-5 (colouring, lumped mass). ``small``: the same nodes at t = 4h², colouring
against selected inversion, both masses. ``inversion``: one time by selected inversion, and its gradient by the entries
of the matrices, on grids, a surface and a volume; seconds of the second call. ``gradient``: that of colouring against
central differences. ``volume``: 96³ nodes, unit metric, lumped mass, t = 4h². The file is written after every case.
Seconds include compilation, where nothing else is said.
"""

import argparse
import resource
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from machine import RESULTS, timed_from_cold, timed_once, write

import hks_jax as hj
from hks_jax.linear.dissection import dissect
from hks_jax.linear.selected_inversion import inversion_cost

N = 256


def smooth(n: int) -> hj.TensorField:
    """Return a field of constant eigenvalues whose directions turn."""
    return hj.examples.figure4_fields(n, major=1.25, minor=0.8)["cells"]


def relative(values: jax.Array, reference: jax.Array) -> float:
    """Return the greatest error relative to the reference's value at the node."""
    return float(jnp.max(jnp.abs(values / reference - 1)))


def by_colouring(field: hj.TensorField, t: float, mass: str, reference: jax.Array | None) -> dict:
    """Measure colouring at one time."""
    settings = hj.colouring(field, [t], mass=mass)
    seconds, values = timed_once(hj.hks_spectrum_free, field, [t], mass=mass, method=settings)
    flat = (4 * np.pi * t) ** (-field.grid.dimension / 2)
    row = {
        "method": "colouring",
        "mass": mass,
        "t_in_h2": t / field.grid.spacing[0] ** 2,
        "vectors": settings.n_vectors(hj.assemble(field, mass=mass).space),
        "spacing": settings.spacing,
        "degree": settings.degree,
        "mass_degree": settings.mass_degree,
        "seconds": seconds,
        "bound": settings.error[0],
        "finite": bool(jnp.isfinite(values).all()),
    }
    if reference is not None:
        row["error"] = float(jnp.max(jnp.abs(values - reference))) / flat
        row["relative_error"] = relative(values, reference)
    return row


def small() -> Iterator[dict]:
    """Measure t = 4h² on 256² nodes."""
    field = smooth(N)
    t = 4 * field.grid.spacing[0] ** 2
    for mass in ("lumped", "consistent"):
        seconds, reference = timed_once(hj.hks_spectrum_free, field, [t], mass=mass, method="selected-inversion")
        yield {"method": "selected inversion", "mass": mass, "t_in_h2": 4.0, "seconds": seconds}
        yield by_colouring(field, t, mass, reference)


def agree() -> Iterator[dict]:
    """Compare with 500 pairs where they suffice."""
    field = smooth(N)
    for mass in ("lumped", "consistent"):
        seconds, pairs = timed_once(hj.eigenpairs, field, 500, mass=mass)
        last = float(pairs.next_eigenvalue)
        yield {"method": "500 pairs", "mass": mass, "solver": pairs.solver_name, "seconds": seconds}
        t = 22 / last
        seconds, values = timed_once(hj.hks_spectrum_free, field, [t], mass=mass, method="selected-inversion")
        row = {"method": "selected inversion", "mass": mass, "t_in_h2": t / field.grid.spacing[0] ** 2}
        yield row | {"seconds": seconds, "relative_error": relative(values, hj.hks(pairs, [t]))}
        if mass == "lumped":
            t = 13 / last
            yield by_colouring(field, t, mass, hj.hks(pairs, [t]))


def inversion() -> Iterator[dict]:
    """Take the time of selected inversion and of its gradient."""
    volume = hj.TensorField(hj.Grid((20, 20, 20), 1 / 19), jnp.broadcast_to(jnp.eye(3), (20, 20, 20, 3, 3)))
    domains = {"grid 128²": smooth(128), "grid 256²": smooth(256), "sphere": hj.examples.sphere_mesh(40)}
    for name, domain in (domains | {"volume 20³": volume}).items():
        pencil = hj.assemble(domain)

        def loss(pencil: hj.Pencil) -> jax.Array:
            return jnp.mean(hj.hks_spectrum_free(pencil, [0.01], method="selected-inversion"))

        value_first_s, value_s, _ = timed_from_cold(eqx.filter_jit(loss), pencil, repeats=1)
        run = eqx.filter_jit(eqx.filter_grad(loss))
        gradient_first_s, gradient_s, _ = timed_from_cold(run, pencil, repeats=1)
        operations, entries = inversion_cost(dissect(pencil.pattern))
        yield {
            "domain": name,
            "nodes": pencil.size,
            "gflop_a_pole": operations / 1e9,
            "factors_GB": 16 * entries / 1e9,
            "value_s": value_s,
            "value_first_s": value_first_s,
            "gradient_s": gradient_s,
            "gradient_first_s": gradient_first_s,
            "peak_GB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6,
        }


def gradient() -> Iterator[dict]:
    """Compare directional derivatives with differences, and take the time of a gradient."""
    for n in (64, 256):
        field = smooth(n)
        times = [4 * field.grid.spacing[0] ** 2]
        settings = hj.colouring(field, times, mass="lumped", slack=1.05)

        def loss(tensors: jax.Array) -> jax.Array:
            moved = hj.TensorField(field.grid, tensors)  # noqa: B023
            return jnp.mean(jnp.log(hj.hks_spectrum_free(moved, times, mass="lumped", method=settings)))  # noqa: B023

        value_s, _ = timed_once(jax.jit(loss), field.tensors)
        run = jax.jit(jax.grad(loss))
        seconds, slope = timed_once(run, field.tensors)
        rng = np.random.default_rng(0)
        direction = rng.standard_normal(field.tensors.shape)
        direction = jnp.asarray(direction + np.swapaxes(direction, -1, -2))
        step = 1e-4
        ends = [float(jax.jit(loss)(field.tensors + sign * step * direction)) for sign in (1, -1)]
        difference = (ends[0] - ends[1]) / (2 * step)
        error = abs(float(jnp.vdot(slope, direction)) - difference) / abs(difference)
        yield {"nodes": n * n, "value_s": value_s, "gradient_s": seconds, "directional_error": error}


def volume() -> Iterator[dict]:
    """Measure 96³ nodes."""
    grid = hj.Grid((96, 96, 96), 1 / 95)
    field = hj.TensorField(grid, jnp.broadcast_to(jnp.eye(3), (96, 96, 96, 3, 3)))
    t = 4 / 95**2
    row = by_colouring(field, t, "lumped", None)
    yield row | {"nodes": 96**3, "peak_GB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6}


CASES = {"small": small, "agree": agree, "inversion": inversion, "gradient": gradient, "volume": volume}


def main() -> None:
    """Measure, print, and write the result file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", nargs="+", default=list(CASES), choices=list(CASES))
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "spectrum_free.json")
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    warnings.simplefilter("ignore", hj.AccuracyWarning)
    rows: list[dict] = []
    more: dict[str, list[dict]] = {"inversion": []}
    for name in args.cases:
        for row in CASES[name]():
            more.get(name, rows).append({"case": name, **row})
            print(row, flush=True)
            write(args.output, rows, **more)


if __name__ == "__main__":
    main()
