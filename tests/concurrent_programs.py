"""Programs in which linear algebra can run beside other linear algebra, called again and again.

Run as ``python concurrent_programs.py CALLS NAME…`` in a process of its own: one in which threads wait for each other
does not end. "NAME + NAME" is one program of two.
"""

import os
import subprocess
import sys
import warnings
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jax.experimental.sparse import BCOO

import hks_jax as hj
from hks_jax.domain import spd

HERE = Path(__file__).parent


def field(tensors, boundary="neumann"):
    shape = tensors.shape[: tensors.shape[-1]]
    x = np.meshgrid(*(np.linspace(-1, 1, n) for n in shape), indexing="ij")
    mask = np.hypot(*x) < 0.99 if boundary == "mean" else None
    return hj.TensorField(hj.Grid(shape, 2 / (shape[0] - 1), -1.0, mask=mask), tensors)


def flat(*shape):
    return jnp.broadcast_to(jnp.eye(len(shape)), (*shape, len(shape), len(shape)))


def signature(boundary, k, tensors, solver="block-lanczos"):
    pairs = hj.eigenpairs(field(tensors, boundary), k, boundary, multiplet="drop", solver=solver)
    return jnp.nansum(hj.hks(pairs, [0.2]) ** 2)


def count(boundary, *shape):
    function = jax.jit(lambda tensors: hj.count_eigenvalues(field(tensors), 300.0, boundary))
    return function, flat(*shape)


def count_of_batch():
    function = jax.jit(jax.vmap(lambda tensors: hj.count_eigenvalues(field(tensors), 300.0, "mirror")))
    return function, jnp.stack([flat(16, 16)] * 2)


def gradient(boundary):
    return jax.jit(jax.grad(partial(signature, boundary, 16))), flat(26, 26)


def product_of_two():
    def loss(tensors):
        return signature("neumann", 25, tensors) * signature("neumann", 25, 1.5 * tensors)

    return jax.jit(jax.grad(loss)), flat(42, 40)


def gradients_of_batch(solver):
    """Two fields of two problems each; the compiler takes a minute for four of each."""
    gradients = jax.vmap(jax.grad(partial(signature, ("mirror", "neumann"), 8, solver=solver)))
    return jax.jit(gradients), jnp.stack([flat(16, 16), 1.3 * flat(16, 16)])


def gradients_on_devices():
    mesh = jax.sharding.Mesh(np.array(jax.devices()), ("batch",))
    function, batch = jax.grad(partial(signature, "mean", 10)), jnp.stack([flat(20, 20)] * 2 * mesh.size)
    return partial(hj.devices.map_fields, function, mesh=mesh), batch


def two_eigsh():
    n = 1600
    path = BCOO.from_scipy_sparse(sp.diags([-1.0, 2.0, -1.0], [-1, 0, 1], shape=(n, n), format="csr"))

    def eigenvalues(entries):
        return hj.eigsh(BCOO((entries, path.indices), shape=path.shape), k=10).eigenvalues

    gradient = jax.grad(lambda entries: jnp.sum(eigenvalues(entries)) * jnp.sum(eigenvalues(2 * entries)))
    return jax.jit(gradient), path.data


def two_matrix_functions():
    rng = np.random.default_rng(0)
    matrices = rng.normal(size=(2, 40, 48, 48))

    def loss(a, b):
        b = b @ b.T + 48 * jnp.eye(48)
        return jnp.sum(hj.matrix_function((a + a.T) / 20, jnp.exp, b) * hj.matrix_function(a + a.T, jnp.sin))

    return jax.jit(jax.vmap(jax.grad(loss, (0, 1)))), *matrices


def spectrum_free():
    def loss(tensors):
        of_one = partial(hj.hks_spectrum_free, times=[0.1], method="selected-inversion")
        return jnp.nansum(of_one(field(tensors)) * of_one(field(1.5 * tensors)))

    return jax.jit(jax.grad(loss)), flat(24, 24)


def logarithms():
    rng = np.random.default_rng(0)
    roots = rng.normal(size=(2, 20_000, 3, 3))
    function = jax.jit(lambda a, b: jnp.sum(spd.log(a @ a.mT + jnp.eye(3)) * spd.log(b @ b.mT + jnp.eye(3))))
    return function, *roots


def beside_a_batch_of_a_user():
    def both(tensors, matrices):
        return signature("neumann", 20, tensors), jnp.linalg.eigh(matrices)

    matrices = jnp.asarray(np.random.default_rng(0).normal(size=(64, 32, 32)))
    return jax.jit(both), flat(20, 20), matrices


def fit():
    truth = field(jnp.exp(0.2 * jnp.arange(12) / 12)[:, None, None, None] * flat(12, 12), "mean")
    times = [0.1, 0.3]
    target = hj.hks(hj.eigenpairs(truth, 30, "mean", multiplet="drop", solver="block-lanczos"), times)
    start = field(flat(12, 12), "mean")
    return (
        lambda: (
            hj.fit_metric(
                start, target, times, "conformal", boundary="mean", search=hj.inverse.Search(max_steps=3)
            ).loss
        ),
    )


PROGRAMS = {
    "count, mirror": partial(count, "mirror", 16, 16),
    "count, mirror in 3D": partial(count, "mirror", 7, 7, 7),
    "count, mirror and neumann": partial(count, ("mirror", "neumann"), 16, 16),
    "count, batch": count_of_batch,
    "gradient, mirror": partial(gradient, "mirror"),
    "gradient, mean": partial(gradient, "mean"),
    "two eigenpairs": product_of_two,
    "batch of gradients": partial(gradients_of_batch, "block-lanczos"),
    "batch of dense gradients": partial(gradients_of_batch, "dense"),
    "gradients on devices": gradients_on_devices,
    "two eigsh": two_eigsh,
    "two matrix functions": two_matrix_functions,
    "spectrum-free": spectrum_free,
    "logarithms": logarithms,
    "beside a user's batch": beside_a_batch_of_a_user,
    "fit": fit,
}


def beside(*names):
    """Return one program of several, and their arguments."""
    functions, arguments = zip(*((function, args) for function, *args in (PROGRAMS[n]() for n in names)), strict=True)
    if len(names) == 1:
        return functions[0], arguments[0]
    return jax.jit(lambda *each: [f(*args) for f, args in zip(functions, each, strict=True)]), arguments


def main(calls, *programs):
    jax.config.update("jax_enable_x64", True)
    warnings.simplefilter("ignore")
    for program in programs:
        print(program, flush=True)
        function, args = beside(*program.split(" + "))
        for _ in range(int(calls)):
            jax.block_until_ready(function(*args))


def run(programs, calls=40, threads=2, devices=1, limit=300):
    """Run programs in a process of its own, on a pool of so many threads; raise AssertionError if they do not end."""
    environment = {key: value for key, value in os.environ.items() if key != "XLA_FLAGS"} | {
        "PYTHONPATH": f"{HERE.parent}{os.pathsep}{HERE}",
        "JAX_PLATFORMS": "cpu",
        "JAX_COMPILATION_CACHE_DIR": str(HERE.parent / ".pytest_cache" / "jax"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.2",
        "PJRT_NPROC": str(threads),  # how many threads JAX's CPU has
    }
    if devices > 1:
        environment["XLA_FLAGS"] = f"--xla_force_host_platform_device_count={devices}"
    on_one_core = ["taskset", "--cpu-list", "0"] if threads == 1 else []
    command = [*on_one_core, sys.executable, __file__, str(calls), *programs]
    try:
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=limit)
    except subprocess.TimeoutExpired as late:
        begun = (late.stdout or b"").decode().splitlines()
        raise AssertionError(f"{begun[-1:]}: not done in {limit} s, {threads} threads, {devices} devices") from None
    assert done.returncode == 0, done.stderr


if __name__ == "__main__":
    main(*sys.argv[1:])
