"""Cost of a gradient over the value alone, and its error beside the usual rules.

    python benchmarks/derivatives/derivatives.py [--problems 64² 32³ surface …] [-o benchmarks/results/derivatives.json]

Cost: value-and-gradient of a loss on the HKS at eight times over the value, by all tensors of a grid or all vertices of
a surface, same solver, same process, in turn, the first calls apart; peak memory of each in a process of its own.
Accuracy: the gradient of a truncated HKS on 24² nodes with respect to every tensor, against contour integrals of
resolvents that JAX differentiates by itself (no eigensolver). Rivals are tried where they are installed:
`jnp.linalg.eigh` after a Cholesky reduction, the `eigh` package, and xitorch on PyTorch.
"""

import argparse
import json
import subprocess
import sys
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from machine import RESULTS, field, timed_once, write

import hks_jax as hj

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
from differences import directional, heat_kernel_by_contour

PROBLEMS = {
    "64²": (partial(field, 64), 100, "block-lanczos"),
    "128²": (partial(field, 128), 200, "block-lanczos"),
    "256²": (partial(field, 256), 500, "block-lanczos"),
    "32³": (partial(field, 32, 3), 200, "chebyshev-filter"),
    "surface": (partial(hj.examples.bumpy_torus_mesh, 256), 100, "block-lanczos"),
    "smaller surface": (partial(hj.examples.bumpy_torus_mesh, 203), 100, "block-lanczos"),
}
"""A domain, which is differentiated by its tensors or vertices, the number of pairs, and the solver."""
N_TIMES = 8


def loss_on(name: str) -> tuple[Callable, jax.Array]:
    """Return a loss on the HKS at eight times, and its argument."""
    make, k, solver = PROBLEMS[name]
    domain = make()
    dimension = hj.assemble(domain).space.dimension
    # Weyl: λ_k t from 10 to 10³.
    volume = float(hj.assemble(domain).volume)
    ball = {2: np.pi, 3: 4 * np.pi / 3}[dimension]
    last = (2 * np.pi) ** 2 * (k / (ball * volume)) ** (2 / dimension)
    times = jnp.geomspace(10 / last, 1000 / last, N_TIMES)
    surface = isinstance(domain, hj.SurfaceMesh)

    def loss(x: jax.Array) -> jax.Array:
        moved = hj.SurfaceMesh(x, domain.faces) if surface else hj.TensorField(domain.grid, x)
        signature = hj.hks(hj.eigenpairs(moved, k, solver=solver), times)
        scale = (4 * jnp.pi * times) ** (dimension / 2)
        return jnp.mean(jnp.log(scale.reshape(-1, *[1] * (signature.ndim - 1)) * signature) ** 2)

    return loss, domain.vertices if surface else domain.tensors


def peak_memory(name: str, what: str) -> float:
    """Return the peak resident memory in GB of one evaluation in a process of its own."""
    command = [sys.executable, __file__, "--only", what, "--problems", name]
    return float(subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()[-1])


def only(what: str, name: str) -> None:
    """Evaluate once and print the peak memory in GB."""
    loss, x = loss_on(name)
    jax.block_until_ready(loss(x) if what == "value" else jax.value_and_grad(loss)(x))
    # Not getrusage, whose peak a child inherits from its parent.
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    print(int(status["VmHWM"].split()[0]) / 1e6)


def cost(name: str, memory: bool) -> dict:
    """Measure one problem."""
    loss, x = loss_on(name)
    seconds, gradients, gradient = [], [], None
    for _ in range(3):  # value and gradient in turn, so that other work on the machine meets both; the first compiles
        seconds.append(timed_once(loss, x)[0])
        spent, (_, gradient) = timed_once(jax.value_and_grad(loss), x)
        gradients.append(spent)
    value, both = min(seconds[1:]), min(gradients[1:])
    direction = np.random.default_rng(0).standard_normal(x.shape)
    direction = 0.01 * (direction + np.swapaxes(direction, -1, -2)) if x.ndim > 2 else 1e-3 * direction
    truth = directional(loss, x, direction, step=0.4)
    row = {
        "problem": name,
        "nodes": int(np.prod(x.shape[: x.ndim - 2])) if x.ndim > 2 else len(x),
        "k": PROBLEMS[name][1],
        "solver": PROBLEMS[name][2],
        "times": N_TIMES,
        "value_s": value,
        "value_and_gradient_s": both,
        "ratio": both / value,
        "value_first_s": seconds[0],
        "gradient_first_s": gradients[0],
        "directional_error": float(abs(jnp.vdot(gradient, direction) - truth) / abs(truth)),
    }
    if memory:
        row["peak_GB"] = {what: peak_memory(name, what) for what in ("value", "gradient")}
    print(f"{name}: " + ", ".join(f"{key} {value:.3g}" for key, value in row.items() if isinstance(value, float)))
    return row


def accuracy() -> list[dict]:
    """Compare whole gradients on 24² nodes."""
    n, k, times = 24, 30, jnp.array([0.02, 0.1])
    grid, rng = hj.Grid((n, n), 1 / (n - 1)), np.random.default_rng(0)
    noise, probe = rng.standard_normal((n, n, 2, 2)), jnp.asarray(rng.standard_normal((2, n * n)))
    noise = (noise + np.swapaxes(noise, -1, -2)) / 2
    names = {"identity": 0.0, "noise 1e-6": 1e-6, "noise 1e-9": 1e-9, "noise 1e-12": 1e-12, "noise 0.2": 0.2}
    rows = []
    for name, size in names.items():
        tensors = jnp.eye(2) + size * jnp.asarray(noise)

        def matrices(tensors: jax.Array) -> tuple[jax.Array, jax.Array]:
            pencil = hj.assemble(hj.TensorField(grid, tensors))
            return pencil.stiffness.to_dense(), pencil.mass.to_dense()

        pairs = hj.eigenpairs(hj.TensorField(grid, tensors), k)
        ends = float(pairs.eigenvalues[-1]), float(pairs.next_eigenvalue)

        def reference(tensors: jax.Array, ends: tuple[float, float] = ends) -> jax.Array:
            # The circle crosses the axis left of 0 and between λ_k and λ_{k+1}.
            kernel = heat_kernel_by_contour(*matrices(tensors), times, *ends, nodes=256)
            return jnp.sum(probe * jnp.diagonal(kernel, axis1=1, axis2=2))

        def ours(tensors: jax.Array, solver: str) -> jax.Array:
            pairs = hj.eigenpairs(hj.TensorField(grid, tensors), k, solver=solver)
            return jnp.sum(probe * hj.hks(pairs, times).reshape(2, -1))

        def by_vectors(tensors: jax.Array, eigh: Callable) -> jax.Array:
            values, vectors = eigh(*matrices(tensors))
            decay = jnp.exp(-times[:, None] * values[:k])
            return jnp.sum(probe * (decay @ jnp.square(vectors[:, :k]).T))

        expected = jax.grad(reference)(tensors)
        results = {f"hks_jax, {s}": jax.grad(ours)(tensors, s) for s in ("dense", "shift-invert")}
        results["jnp.linalg.eigh"] = jax.grad(by_vectors)(tensors, by_cholesky)
        try:
            import eigh

            results["eigh package"] = jax.grad(by_vectors)(tensors, eigh.eigh)
        except ImportError:
            print("eigh is not installed")
        try:
            results["xitorch"] = with_xitorch(tensors, matrices, probe, times, k)
        except ImportError:
            print("xitorch is not installed")
        scale = jnp.linalg.norm(expected)
        errors = {who: float(jnp.linalg.norm(gradient - expected) / scale) for who, gradient in results.items()}
        rows.append({"field": name, "nodes": n * n, "k": k, "relative_errors": errors})
        print(name, {who: f"{error:.1e}" for who, error in errors.items()})
    return rows


def by_cholesky(K: jax.Array, M: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Solve Kφ = λMφ by a Cholesky reduction and `jnp.linalg.eigh`, differentiated by JAX."""
    factor = jnp.linalg.cholesky(M)
    half = solve_triangular(factor, K, lower=True)
    reduced = solve_triangular(factor, half.T, lower=True)
    values, vectors = jnp.linalg.eigh((reduced + reduced.T) / 2)
    return values, solve_triangular(factor, vectors, trans="T", lower=True)


def with_xitorch(tensors: jax.Array, matrices: Callable, probe: jax.Array, times: jax.Array, k: int) -> jax.Array:
    """Return xitorch's gradient through its exact symmetric eigensolver; JAX assembles."""
    import torch
    import xitorch
    from xitorch.linalg import symeig

    (K, M), pull_back = jax.vjp(matrices, tensors)
    K, M = (torch.tensor(np.array(x), requires_grad=True) for x in (K, M))
    values, vectors = symeig(
        xitorch.LinearOperator.m(K, is_hermitian=True), neig=k, M=xitorch.LinearOperator.m(M, is_hermitian=True),
        method="exacteig",
    )  # fmt: skip
    decay = torch.exp(-torch.tensor(np.array(times))[:, None] * values)
    (torch.tensor(np.array(probe)) * (decay @ (vectors**2).T)).sum().backward()
    return pull_back(tuple(jnp.asarray(x.grad.numpy()) for x in (K, M)))[0]


def main() -> None:
    """Measure, print, and write the result file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--problems", nargs="+", default=list(PROBLEMS), choices=list(PROBLEMS))
    parser.add_argument("--memory", nargs="*", default=["256²"], choices=list(PROBLEMS), help="peak memory of which")
    parser.add_argument("--cost-alone", action="store_true", help="leave the accuracy in the file as it is")
    parser.add_argument("--only", choices=["value", "gradient"], help=argparse.SUPPRESS)
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "derivatives.json")
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    warnings.simplefilter("ignore", hj.AccuracyWarning)
    if args.only:
        only(args.only, args.problems[0])
        return
    compared = json.loads(args.output.read_text())["accuracy"] if args.cost_alone else accuracy()
    write(args.output, [cost(name, name in args.memory) for name in args.problems], accuracy=compared)


if __name__ == "__main__":
    main()
