"""Factorisations of sparse symmetric matrices, solves, and log-determinants with gradients, beside SuperLU and CHOLMOD.

    python benchmarks/eigensolvers/factorisation.py [--cases 128 512 s65000] [-o benchmarks/results/factorisation.json]

Matrices K − σM of anisotropic tensors on n² nodes, or of a closed surface with bumps, definite (σ = −1) and indefinite
(σ above about 100 eigenvalues). CHOLMOD is that of sparsax, where it is installed, and takes definite ones alone. Every
call has other numbers: it keeps factors of those it has seen.
"""

import argparse
import os
import sys
from collections.abc import Callable
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

import jax
import jax.numpy as jnp
import machine
import numpy as np
from eigensolvers import domain
from machine import RESULTS, write
from scipy.sparse.linalg import splu

import hks_jax as hj

COLUMNS = 8
timed = partial(machine.timed, repeats=2)


def ours(pencil: hj.Pencil, shift: float, b: np.ndarray) -> tuple[dict[str, float], np.ndarray, int]:
    """Measure this package; return times, the solution, and how many eigenvalues are negative."""
    shifts, rhs = (jnp.asarray(shift * (1 + 1e-9 * i)) for i in count()), jnp.asarray(b)
    factorise_s, factor = timed(lambda: hj.factorise(pencil, next(shifts)))

    def log_determinant(stiffness: Any, shift: jax.Array) -> jax.Array:
        return hj.factorise(pencil.with_stiffness(stiffness), shift).logdet()

    gradient = jax.jit(jax.value_and_grad(log_determinant))
    solve = jax.jit(lambda factor, b: factor.solve(b))
    times = {
        "factorise_s": factorise_s,
        "solve_s": timed(solve, factor, rhs[:, 0])[0],
        "solve_8_s": timed(solve, factor, rhs)[0],
        "log_determinant_s": timed(lambda: hj.factorise(pencil, next(shifts)).logdet())[0],
        "log_determinant_and_gradient_s": timed(lambda: gradient(pencil.stiffness, next(shifts)))[0],
    }
    factor = hj.factorise(pencil, shift)
    return times, np.asarray(factor.solve(rhs)), int(factor.inertia.negative)


def superlu(pencil: hj.Pencil, shift: float, b: np.ndarray) -> tuple[dict[str, float], np.ndarray, int]:
    """Measure SuperLU, set for symmetric matrices: no pivoting where the matrix is definite."""
    matrix = (pencil.stiffness.to_scipy() - shift * pencil.mass.to_scipy()).tocsc()
    settings: dict = {"permc_spec": "MMD_AT_PLUS_A", "options": {"SymmetricMode": True}}
    factorise: Callable = partial(splu, matrix, diag_pivot_thresh=0.0 if shift < 0 else 0.01, **settings)
    factorise_s, factor = timed(factorise)
    times = {
        "factorise_s": factorise_s,
        "solve_s": timed(factor.solve, b[:, 0])[0],
        "solve_8_s": timed(factor.solve, b)[0],
        "log_determinant_s": timed(lambda: np.log(np.abs(factorise().U.diagonal())).sum())[0],
    }
    return times, factor.solve(b), -1


def cholmod(pencil: hj.Pencil, shift: float, b: np.ndarray) -> tuple[dict[str, float], np.ndarray, int]:
    """Measure CHOLMOD in sparsax, which keeps the ordering of a pattern, as we do."""
    import sparsax

    matrix = (pencil.stiffness.to_scipy() - shift * pencil.mass.to_scipy()).tocoo()
    rows, cols, n = jnp.asarray(matrix.row), jnp.asarray(matrix.col), matrix.shape[0]
    entries = (jnp.asarray(matrix.data * (1 + 1e-9 * i)) for i in count())
    fixed, rhs = jnp.asarray(matrix.data), jnp.asarray(b)
    log_determinant = jax.jit(lambda values: sparsax.logdet(rows, cols, values, n))
    solve = jax.jit(lambda b: sparsax.solve(rows, cols, fixed, b))
    gradient = jax.jit(jax.value_and_grad(lambda values: sparsax.logdet(rows, cols, values, n)))
    factorise_s = timed(lambda: log_determinant(next(entries)))[0]
    times = {
        "factorise_s": factorise_s,
        "solve_s": timed(solve, rhs[:, 0])[0],
        "solve_8_s": timed(solve, rhs)[0],
        "log_determinant_s": factorise_s,
        "log_determinant_and_gradient_s": timed(lambda: gradient(next(entries)))[0],
    }
    return times, np.asarray(solve(rhs)), 0


PROGRAMS: dict[str, Callable] = {"hks_jax": ours, "SuperLU": superlu, "CHOLMOD": cholmod}


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="+", default=["128", "512", "s65000"], metavar="N or sN")
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "factorisation.json")
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    rows = []
    for case in args.cases:
        pencil = hj.assemble(domain(case))
        name = f"surface, {pencil.size:,}" if case.startswith("s") else f"{case}²"
        b = np.random.default_rng(0).standard_normal((pencil.size, COLUMNS))
        # By Weyl's law a hundred eigenvalues are below the second shift.
        for shift in (-1.0, float(4 * np.pi * 100 / pencil.volume)):
            matrix = (pencil.stiffness.to_scipy() - shift * pencil.mass.to_scipy()).tocsr()
            norm = abs(matrix).sum(axis=1).max()
            for program, measure in PROGRAMS.items():
                if program == "CHOLMOD" and shift > 0:
                    continue
                try:
                    times, x, negative = measure(pencil, shift, b)
                except ImportError:
                    continue
                error = float(np.abs(matrix @ x - b).max() / (norm * np.abs(x).max() + np.abs(b).max()))
                kind = "definite" if shift < 0 else "indefinite"
                rows.append({"matrix": name, "kind": kind, "program": program, **times, "backward_error": error})
                print(rows[-1], "negative eigenvalues:", negative)
    write(args.output, rows, load=round(os.getloadavg()[0], 1))


if __name__ == "__main__":
    main()
