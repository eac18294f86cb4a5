"""Errors and cost of derivatives of dense symmetric matrices at equal and nearly equal eigenvalues.

    python benchmarks/derivatives/dense.py [-o benchmarks/results/dense.json]

Gradients of two functions of a 12×12 matrix with eigenvalues of multiplicity 4, 3, 1, 2, 1, 1, to which noise is added:
tr(W e^A) against SciPy's `expm_frechet`, and tr(W P), P the projector on the cluster of three, against a contour
integral of resolvents.
"""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import jax
import jax.numpy as jnp
import numpy as np
from machine import RESULTS, timed, write
from scipy.linalg import expm_frechet

import hks_jax as hj

VALUES = np.array([1.0] * 4 + [2.0] * 3 + [3.0] + [4.0] * 2 + [5.0, 6.0])


def symmetric(rng: np.random.Generator, n: int) -> np.ndarray:
    """Return a random symmetric matrix."""
    matrix = rng.standard_normal((n, n))
    return (matrix + matrix.T) / 2


def by_vectors(eigh: Callable, **settings: float) -> tuple[Callable, Callable]:
    """Return e^A and the projector, as one would compute them from eigenpairs."""

    def exponential(matrix: jax.Array) -> jax.Array:
        values, vectors = eigh(matrix, **settings)
        return (vectors * jnp.exp(values)) @ vectors.T

    def projector(matrix: jax.Array) -> jax.Array:
        vectors = eigh(matrix, **settings)[1][:, 4:7]
        return vectors @ vectors.T

    return exponential, projector


def accuracy() -> list[dict]:
    """Compare whole gradients; errors relative to the largest entry."""
    rng = np.random.default_rng(0)
    frame = np.linalg.qr(rng.standard_normal((12, 12)))[0]
    noise, W = symmetric(rng, 12), 2 * symmetric(rng, 12)
    z = 2 + 0.5 * np.exp(2j * np.pi * (np.arange(64) + 0.5) / 64)
    rivals = {
        "jnp.linalg.eigh": by_vectors(jnp.linalg.eigh),
        "hj.eigh": by_vectors(hj.eigh),
        "hj.eigh, multiplet_tolerance=1e-5": by_vectors(hj.eigh, multiplet_tolerance=1e-5),
        "hj.matrix_function": (
            lambda matrix: hj.matrix_function(matrix, jnp.exp),
            lambda matrix: hj.matrix_function(matrix, lambda x: (x > 1.5) & (x < 2.5)),
        ),
    }
    rows = []
    for size in (0.0, 1e-12, 1e-9, 1e-6, 1e-3):
        A = frame @ np.diag(VALUES) @ frame.T + size * noise
        A = (A + A.T) / 2
        resolvents = np.linalg.inv(z[:, None, None] * np.eye(12) - A)
        truths = (
            expm_frechet(A, W, compute_expm=False),
            np.einsum("z,zij,jk,zkl->il", (z - 2) / 64, resolvents, W, resolvents).real,
        )
        for name, functions in rivals.items():
            row: dict = {"noise": size, "method": name}
            for key, f, truth in zip(("exponential", "projector"), functions, truths, strict=True):
                gradient = np.asarray(jax.grad(lambda A, f=f: jnp.vdot(f(A), W))(A))
                row[key] = float(np.abs(gradient - truth).max() / np.abs(truth).max())
            rows.append(row)
            print(row)
    return rows


def cost(n: int) -> dict:
    """Time the exponential of one matrix, its gradient, and a product with its Hessian, compiled."""
    rng = np.random.default_rng(n)
    A, W = symmetric(rng, n) / np.sqrt(n), symmetric(rng, n)

    def loss(matrix: jax.Array) -> jax.Array:
        return jnp.vdot(hj.matrix_function(matrix, jnp.exp), W)

    row: dict = {"n": n, "eigh_s": timed(jax.jit(jnp.linalg.eigh), A)[0], "value_s": timed(jax.jit(loss), A)[0]}
    row["value_and_gradient_s"] = timed(jax.jit(jax.value_and_grad(loss)), A)[0]
    if n <= 200:
        product = jax.jit(lambda A: jax.jvp(jax.grad(loss), (A,), (jnp.asarray(W),))[1])
        row["hessian_product_s"] = timed(product, A, repeats=1)[0]
    print(row)
    return row


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "dense.json")
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    compared = accuracy()
    write(args.output, [cost(n) for n in (50, 200, 800)], accuracy=compared)


if __name__ == "__main__":
    main()
