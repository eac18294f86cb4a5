"""What a gradient costs over the value alone, and how exact it is beside the usual rules.

    python benchmarks/derivatives.py [--sizes 64 128 256] [-o benchmarks/results/derivatives.json]

Cost: value-and-gradient of a loss on the HKS at eight times over the value, same solver, same process, after a
warm-up; peak memory of each in a process of its own. Accuracy: the gradient of a truncated HKS on 24² nodes with
respect to every tensor, against contour integrals of resolvents that JAX differentiates by itself (no eigensolver).
Rivals are tried where they are installed: `jnp.linalg.eigh` after a Cholesky reduction, the `eigh` package, and xitorch
on PyTorch.
"""

import argparse
import subprocess
import sys
import warnings
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from machine import RESULTS, field, timed, write

import hks_jax as hj
from hks_jax.eigen.choice import choose_solver

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
from differences import directional, heat_kernel_by_contour

PAIRS = {64: 100, 128: 200, 256: 500}
N_TIMES = 8


def loss_on(n: int) -> tuple[Callable, jax.Array]:
    """Return a loss on the HKS of n² nodes at eight times, and the tensors."""
    given = field(n)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", hj.AccuracyWarning)
        pairs = hj.eigenpairs(given, 20, solver="shift-invert")
    # Weyl: λ_k t from 10 to 10³.
    last = float(pairs.eigenvalues[-1]) * PAIRS[n] / 20
    times = jnp.geomspace(10 / last, 1000 / last, N_TIMES)

    def loss(tensors: jax.Array) -> jax.Array:
        pairs = hj.eigenpairs(hj.TensorField(given.grid, tensors), PAIRS[n])
        signature = 4 * jnp.pi * times[:, None, None] * hj.hks(pairs, times)
        return jnp.sum(jnp.log(signature) ** 2)

    return loss, given.tensors


def peak_memory(n: int, what: str) -> float:
    """Return the peak resident memory in GB of one evaluation in a process of its own."""
    command = [sys.executable, __file__, "--only", what, "--sizes", str(n)]
    return float(subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()[-1])


def only(what: str, n: int) -> None:
    """Evaluate once and print the peak memory in GB."""
    loss, tensors = loss_on(n)
    if what == "value":
        jax.block_until_ready(loss(tensors))
    elif what == "gradient":
        jax.block_until_ready(jax.value_and_grad(loss)(tensors))
    # Not getrusage, whose peak a child inherits from its parent.
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    print(int(status["VmHWM"].split()[0]) / 1e6)


def cost(n: int) -> dict:
    """Measure one size."""
    loss, tensors = loss_on(n)
    solver_name = choose_solver("auto", hj.assemble(field(n)), PAIRS[n]).name
    repeats = 3 if n < 256 else 1
    value, _ = timed(loss, tensors, repeats=repeats)
    both, (_, gradient) = timed(jax.value_and_grad(loss), tensors, repeats=repeats)
    rng = np.random.default_rng(0)
    direction = rng.standard_normal(tensors.shape)
    direction = 0.01 * (direction + np.swapaxes(direction, -1, -2))
    difference = None
    if n < 256:
        truth = directional(loss, tensors, direction, step=0.4)
        difference = float(abs(jnp.vdot(gradient, direction) - truth) / abs(truth))
    memory = {what: peak_memory(n, what) for what in ("nothing", "value", "gradient")}
    row = {
        "nodes": n * n,
        "k": PAIRS[n],
        "solver": solver_name,
        "times": N_TIMES,
        "value_s": value,
        "value_and_gradient_s": both,
    }
    row |= {"ratio": both / value, "directional_error": difference, "peak_GB": memory}
    print(f"{n}²/{PAIRS[n]}: value {value:.2f} s, with gradient {both:.2f} s, ratio {both / value:.2f}, ", end="")
    print(f"error {difference}, peak {memory}")
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
    parser.add_argument("--sizes", type=int, nargs="+", default=list(PAIRS), choices=list(PAIRS))
    parser.add_argument("--only", choices=["nothing", "value", "gradient"], help=argparse.SUPPRESS)
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "derivatives.json")
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    warnings.simplefilter("ignore", hj.AccuracyWarning)
    if args.only:
        only(args.only, args.sizes[0])
        return
    compared = accuracy()
    write(args.output, [cost(n) for n in args.sizes], accuracy=compared)


if __name__ == "__main__":
    main()
