"""One small call of every public function, for the modes in which JAX finds mistakes of its users.

The field has a mask, so that results contain the NaN that is meant, and is so small that the dense solver serves it.
"""

import gc
import warnings
from collections.abc import Callable
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import hks_jax as hj

SHAPE = (9, 8)
INDICES = np.indices(SHAPE) - 4
MASK = np.hypot(*INDICES) < 4.2
TENSORS = np.eye(2) * np.exp(0.05 * INDICES[0])[..., None, None]
GRID = hj.Grid(SHAPE, 1.0, mask=MASK)
TIMES, SOURCE = [4.0, 8.0], [[4, 4]]
MATRIX = np.diag([1.0, 2.0, 5.0]) + 0.1


def field(tensors: Any = TENSORS) -> hj.TensorField:
    """Return the field of these tensors."""
    return hj.TensorField(GRID, tensors)


def whole() -> hj.TensorField:
    """Return a field without a mask."""
    return hj.TensorField(hj.Grid(SHAPE, 1.0), TENSORS)


@cache
def pairs() -> hj.Eigenpairs:
    """Return the eigenpairs on which signatures are tried."""
    return hj.eigenpairs(field(), 12, "mean")


@cache
def closed() -> hj.Eigenpairs:
    """Return eigenpairs of a torus, whose heat trace has a known expansion."""
    return hj.eigenpairs(whole(), 20, "periodic")


def signature(tensors: Any) -> Any:
    """Return a signature as a function of the tensors."""
    return hj.hks(hj.eigenpairs(field(tensors), 12, "mean"), jnp.asarray(TIMES))


def loss(tensors: Any) -> Any:
    """Return a number that depends on a signature."""
    return jnp.nansum(signature(tensors))


def surface() -> hj.SurfaceMesh:
    """Return an octahedron."""
    vertices = np.concatenate([np.eye(3), -np.eye(3)])
    faces = [[a, b, c] for a in (0, 3) for b in (1, 4) for c in (2, 5)]
    return hj.SurfaceMesh(vertices, np.array([f if np.linalg.det(vertices[f]) > 0 else f[::-1] for f in faces]))


def potential(x: Any) -> Any:
    """Return a potential, given as a function of the position."""
    return 0.1 * x[0] ** 2


CALLS: dict[str, Callable[[], Any]] = {
    "align": lambda: hj.align(pairs(), pairs(), (SOURCE, SOURCE)),
    "assemble": lambda: hj.assemble(field(), "mean"),
    "assemble with fields": lambda: hj.assemble(field(), potential=potential, density=np.ones(SHAPE)),
    "assemble cancelling": lambda: hj.assemble(field(), quadrature="cancelling"),
    "assemble_forms": lambda: hj.assemble_forms(field(), fields={"potential": potential}),
    "assemble a mesh": lambda: hj.assemble(surface(), degree=2),
    "biharmonic_distance": lambda: hj.biharmonic_distance(pairs(), SOURCE),
    "boundary_influence": lambda: hj.boundary_influence(pairs(), TIMES),
    "colouring": lambda: hj.colouring(field(), [0.5]),
    "count_eigenvalues": lambda: hj.count_eigenvalues(field(), 0.5),
    "crop": lambda: hj.crop(hj.reflect(field(), 2).tensors[..., 0, 0], GRID),
    "decompose": lambda: hj.decompose(pairs(), [TENSORS[..., 0, 0], TENSORS[..., 1, 1]]),
    "decompose unmeasured": lambda: hj.decompose(pairs(), np.where(INDICES[0] == 2, np.nan, TENSORS[..., 0, 0])),
    "default_boundary": lambda: hj.default_boundary(MASK),
    "default_energies": lambda: hj.default_energies(pairs(), 40),
    "default_times": lambda: hj.default_times(pairs(), 3),
    "degenerate_points": lambda: hj.degenerate_points(hj.examples.degenerate_point_field(0.5, 9)),
    "diffusion_distance": lambda: hj.diffusion_distance(pairs(), TIMES, SOURCE),
    "eigenpairs": lambda: [hj.eigenpairs(field(), 5, solver=name) for name in ("dense", "shift-invert")],
    "eigh": lambda: hj.eigh(MATRIX),
    "eigsh": lambda: hj.eigsh(MATRIX, k=2),
    "energy": lambda: hj.energy(pairs(), TENSORS[..., 0, 0]),
    "factorise": lambda: hj.factorise(field(), 1.0).solve(jnp.ones(int(pairs().space.domain.sum()))),
    "gaussian_curvature": lambda: hj.gaussian_curvature(field()),
    "gaussian_scale_space": lambda: hj.gaussian_scale_space(field(), TIMES, TENSORS[..., 0, 0]),
    "global_point_signature": lambda: hj.global_point_signature(pairs()),
    "gradient": lambda: jax.grad(loss)(jnp.asarray(TENSORS)),
    "gradient of a matrix function": lambda: jax.grad(lambda A: hj.matrix_function(A, jnp.exp)[0, 1])(
        jnp.asarray(MATRIX)
    ),
    "heat_coefficients": lambda: hj.heat_coefficients(closed(), 0),
    "heat_flow": lambda: hj.heat_flow(pairs(), TIMES, TENSORS[..., 0, 0]),
    "heat_kernel": lambda: hj.heat_kernel(pairs(), TIMES, SOURCE),
    "heat_trace": lambda: hj.heat_trace(pairs(), TIMES),
    "hks": lambda: [hj.hks(pairs(), TIMES, name) for name in ("raw", "flat", "volume", "heat-trace")],
    "hks_auto": lambda: hj.hks_auto(pairs(), [0.5, 8.0]),
    "hks_expansion": lambda: hj.hks_expansion(field(), [0.5], order=1),
    "hks_spectrum_free": lambda: hj.hks_spectrum_free(field(), TIMES),
    "laplace_beltrami": lambda: hj.laplace_beltrami(field(), TENSORS[..., 0, 0]),
    "log_determinant": lambda: hj.log_determinant(closed(), hj.heat_coefficients(closed(), 0)),
    "matrix_function": lambda: hj.matrix_function(MATRIX, jnp.exp),
    "push": lambda: jax.jvp(loss, (jnp.asarray(TENSORS),), (jnp.asarray(TENSORS),)),
    "reconstruct": lambda: hj.reconstruct(pairs(), np.ones(12)),
    "reflect": lambda: hj.reflect(field(), 2),
    "region_statistics": lambda: hj.region_statistics(hj.hks(pairs(), TIMES), MASK.astype(int)),
    "scalar_curvature": lambda: hj.scalar_curvature(field()),
    "scale_invariant_hks": lambda: hj.scale_invariant_hks(pairs(), 3, 16),
    "shape_dna": lambda: hj.shape_dna(pairs()),
    "smooth": lambda: hj.smooth(field(), TENSORS[..., 0, 0], 2.0),
    "smooth_tensors": lambda: hj.smooth_tensors(GRID, TENSORS, 1.0),
    "sparse_pencil": lambda: hj.sparse_pencil(MATRIX),
    "spectral_filter": lambda: hj.spectral_filter(pairs(), TENSORS[..., 0, 0], lambda x: 1 / (1 + x)),
    "spectral_signature": lambda: hj.spectral_signature(pairs(), lambda p, x: p / (1 + x), jnp.ones(1)),
    "surrogates": lambda: hj.surrogates(pairs(), TENSORS[..., 0, 0], jax.random.key(0), 2),
    "tensor_invariants": lambda: hj.tensor_invariants(field()),
    "truncation": lambda: hj.truncation(pairs(), TIMES),
    "truncation_map": lambda: hj.truncation_map(pairs(), TIMES),
    "uncertainty": lambda: hj.uncertainty(signature, TENSORS, hj.TensorNoise.relative(TENSORS, 0.05, GRID)),
    "varadhan_distance": lambda: hj.varadhan_distance(pairs(), [2.0], SOURCE),
    "weyl_count": lambda: hj.weyl_count(pairs(), [1.0], field()),
    "wks": lambda: hj.wks(pairs(), [-1.0], 0.5),
}
"""Calls by the names of the functions, some with a further word."""

OTHERS = {"compiler_options", "keep_compiled", "fit_metric", "identifiability"}
"""Public functions without a call here: one changes a setting, and the others run the solvers of optimistix."""

STEPS: dict[str, Callable[[Any], Any]] = {
    "value and gradient": jax.value_and_grad(loss),
    "on the host": jax.value_and_grad(
        lambda T: jnp.nansum(hj.hks(hj.eigenpairs(field(T), 12, solver="shift-invert"), jnp.asarray(TIMES)))
    ),
    "without a spectrum": lambda T: hj.hks_spectrum_free(field(T), jnp.asarray(TIMES)),
    "curvature": lambda T: hj.gaussian_curvature(field(T)),
}
"""Functions of the tensors that are compiled as a whole."""


def quietly(call: Callable[[], Any]) -> Any:
    """Run a call to its end without its warnings."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return jax.block_until_ready(call())


def run_strictly(name: str) -> Any:
    """Run one of the calls where JAX forbids NaN and promotion of ranks."""
    with jax.debug_nans(True), jax.numpy_rank_promotion("raise"):
        return quietly(CALLS[name])


def run_guarded(name: str) -> Any:
    """Compile one of the steps where JAX forbids leaks of tracers, and run it where JAX forbids implicit transfers."""
    tensors = jax.device_put(TENSORS)
    gc.collect()
    gc.freeze()  # after each trace JAX looks for leaks in all objects but those that are frozen
    try:
        with jax.checking_leaks():
            step = jax.jit(partial(STEPS[name])).lower(tensors).compile()
    finally:
        gc.unfreeze()
    with jax.transfer_guard("disallow"):
        return quietly(partial(step, tensors))
