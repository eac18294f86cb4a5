"""What tests/project/test_devices.py runs in processes of its own, where the number of devices can be chosen.

    python work_on_devices.py devices                      on the (virtual) devices of this process
    python work_on_devices.py process INDEX PORT           as one of two processes that talk over loopback
    python work_on_devices.py all-process INDEX PORT       likewise, with eigenpairs

Prints, as JSON, how far each result is from that of one device.
"""

import json
import sys
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from fields import random_spd

import hks_jax as hj
from hks_jax.devices import map_fields
from hks_jax.fem.halo import Slabs
from hks_jax.fem.stencil import Stencil
from hks_jax.linear import lapack

warnings.simplefilter("error")
jax.config.update("jax_enable_x64", True)
MODE = sys.argv[1]
RNG = np.random.default_rng(5)


def difference(a, b):
    """The largest, relative to the largest value, on what this process holds of the first."""
    b = np.asarray(b)
    shards = [(s.data, b[s.index]) for s in a.addressable_shards]
    assert all(x.shape == y.shape for x, y in shards)
    return max(float(np.abs(np.asarray(x) - y).max()) for x, y in shards) / float(np.abs(b).max())


def halo(mesh, shape, periodic):
    """The product of a stencil with columns, on slabs and on one device."""
    slabs = Slabs(mesh, shape, periodic)
    c, x = RNG.standard_normal((3 ** len(shape), *shape)), RNG.standard_normal((*shape, 3))

    def share(c, x):
        return Stencil(c, periodic).own(slabs) @ slabs.own(x)

    spec = jax.sharding.PartitionSpec
    on_slabs = jax.shard_map(share, mesh=slabs.mesh, in_specs=spec(), out_specs=spec(slabs.name), check_vma=False)
    return difference(slabs.join(jax.jit(on_slabs)(c, x)), Stencil(c, periodic) @ jnp.asarray(x))


def batch(mesh):
    """The signatures of ten slices, shared out, and one by one."""
    grid = hj.Grid((5, 6), 0.3)
    tensors = random_spd(RNG, (10, 5, 6))[..., :2, :2]
    scales = RNG.uniform(1, 2, 10)

    def signature(entry):
        T, scale = entry
        return hj.hks(hj.eigenpairs(hj.TensorField(grid, scale * T), 12, solver="dense"), jnp.array([0.5, 1.0]))

    got = map_fields(signature, (tensors, scales), mesh)
    expected = jax.lax.map(signature, (jnp.asarray(tensors), jnp.asarray(scales)))
    return difference(got, expected)


def inverses(mesh):
    """Batches of inverses by LAPACK on every device at once: without care they wait for one another for ever."""
    matrices = RNG.normal(size=(mesh.size, 40, 12, 12)) + 12 * np.eye(12)

    def inverse_of_inverse(batch):
        return jax.vmap(lapack.inverse)(jax.vmap(lapack.inverse)(batch))

    return difference(map_fields(inverse_of_inverse, matrices, mesh), matrices)


def exponentials(mesh):
    """The gradient of tr e^A of matrices on every device; a shard_map marks what differs between devices."""
    matrices = RNG.standard_normal((mesh.size, 4, 4))
    matrices = jnp.asarray(matrices + matrices.swapaxes(1, 2))
    own = jax.sharding.Mesh(mesh.devices, mesh.axis_names)
    spec = jax.sharding.PartitionSpec(mesh.axis_names[0])
    function = jax.vmap(lambda a: hj.matrix_function(a, jnp.exp))
    shared = jax.shard_map(function, mesh=own, in_specs=spec, out_specs=spec)
    gradient = jax.jit(jax.grad(lambda a: jnp.sum(jnp.trace(shared(a), axis1=1, axis2=2))))(matrices)
    return difference(gradient, np.stack([scipy.linalg.expm(a) for a in np.asarray(matrices)]))


def eigenpairs(mesh, shape, k, block):
    """The same eigenvalues and spectral projections as on one device, and as from a dense solver."""
    x = np.stack(np.meshgrid(*(np.linspace(0, 1, n) for n in shape), indexing="ij"))
    T = np.exp(0.3 * np.sin(3 * x[0] + 2 * x[1]))[..., None, None] * np.diag([1.0, 1.7])
    pencil = hj.assemble(hj.TensorField(hj.Grid(shape, 1 / (shape[0] - 1)), T))
    one, several = hj.ChebyshevFilter(block=block), hj.ChebyshevFilter(block=block, mesh=mesh)
    assert one.plan(k + 1, pencil).size == several.plan(k + 1, pencil).size
    values, vectors, _ = one.lowest(pencil, k + 1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", hj.AccuracyWarning)  # k may cut a pair of eigenvalues
        together = hj.eigenpairs(pencil, k, solver=several)
    dense = scipy.linalg.eigh(pencil.stiffness.to_dense(), pencil.mass.to_dense(), eigvals_only=True)
    times = np.array([0.15, 0.3])
    signature = np.exp(-times[:, None] * np.asarray(values)[:k]) @ np.asarray(vectors)[:k] ** 2
    return {
        "converged": bool(np.all(together.converged)),
        "eigenvalues": difference(together.eigenvalues, values[:k]),
        "against dense": difference(together.eigenvalues, dense[:k]),
        "signature": difference(hj.hks(together, times), signature.reshape(2, *shape)),
    }


def refusals(mesh):
    """What wrong calls say."""
    grid_mesh = jax.sharding.Mesh(mesh.devices.reshape(2, -1), ("a", "b"))
    calls = [
        lambda: hj.ChebyshevFilter(mesh=grid_mesh),
        lambda: map_fields(jnp.sin, {"a": np.zeros((3, 2)), "b": np.zeros(4)}, mesh),
        lambda: map_fields(jnp.sin, np.zeros(4), grid_mesh),
    ]
    messages = []
    for call in calls:
        try:
            call()
        except ValueError as error:
            messages.append(str(error))
    return messages


def main():
    if MODE != "devices":
        index, port = map(int, sys.argv[2:])
        jax.distributed.initialize(f"127.0.0.1:{port}", num_processes=2, process_id=index)
    # As most users make one; its axes are of JAX's default type.
    mesh = jax.make_mesh((jax.device_count(),), ("devices",))
    found = {"devices": mesh.size, "processes": jax.process_count()}
    if MODE == "devices":
        found["refusals"] = refusals(mesh)
        found["halo"] = [
            halo(mesh, (16, 5), (False, True)),
            halo(mesh, (9, 5), (True, False)),
            halo(mesh, (9, 3, 4), (False, True, False)),
        ]
        found["batch"] = batch(mesh)
        found["inverses"] = inverses(mesh)
        found["exponentials"] = exponentials(mesh)
        found["eigenpairs"] = eigenpairs(mesh, (19, 17), 7, 2)
    else:
        found["halo"] = [halo(mesh, (9, 4), (True, False))]
        if MODE == "all-process":
            found["eigenpairs"] = eigenpairs(mesh, (19, 17), 7, 4)
    print(json.dumps(found))


if __name__ == "__main__":
    main()
