# %% [markdown]
# # Several devices
#
# Batches, times, eigenvectors and space can be shared out among the devices of a mesh with one axis. The results are
# those of one device, to rounding. Where there is only one CPU, it is made to look like eight here: that shows what
# goes where, and makes nothing faster.

# %%
import os

# Before JAX starts. It is for the CPU alone; GPUs are found as they are.
if "xla_force_host_platform_device_count" not in os.environ.get("XLA_FLAGS", ""):
    os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=8"

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.patches import Rectangle

import hks_jax as hj

jax.config.update("jax_enable_x64", True)

devices = jax.devices() if jax.device_count() > 1 else jax.devices("cpu")
mesh, alone = (jax.sharding.Mesh(np.array(some), ("devices",)) for some in (devices, devices[:1]))
print(f"{mesh.size} devices: {devices[0].device_kind}")
assert mesh.size > 1


def difference(a, b):  # the largest, relative to the largest value
    a, b = np.asarray(a), np.asarray(b)
    return float(np.abs(a - b).max() / np.abs(b).max())


# %% [markdown]
# ## Batches
#
# Metrics on one grid, from a flat one to a wavy one, two for each device. Nothing is exchanged.

# %%
grid = hj.Grid((24, 24), 1 / 23)
x, y = np.moveaxis(grid.nodes, -1, 0)
heights = np.linspace(0.0, 1.0, 2 * mesh.size)
batch = np.exp(heights[:, None, None] * np.sin(5 * x) * np.cos(4 * y))[..., None, None] * np.eye(2)
times = jnp.array([0.02, 0.1])


def signature(tensors):
    return hj.hks(hj.eigenpairs(hj.TensorField(grid, tensors), 60, solver="dense"), times)


signatures = hj.devices.map_fields(signature, batch, mesh)
shares = [(shard.device.id, shard.data.shape[0]) for shard in signatures.addressable_shards]
print("(device, signatures):", shares)
assert [number for _, number in shares] == [2] * mesh.size
assert difference(signatures, jax.lax.map(signature, jnp.asarray(batch))) < 1e-10

# %% [markdown]
# ## Times
#
# Without a spectrum, by selected inversion, every time is a computation of its own.

# %%
wavy = hj.assemble(hj.TensorField(grid, batch[-1]))
small = jnp.geomspace(0.002, 0.02, mesh.size)


def without_spectrum(t):
    return hj.hks_spectrum_free(wavy, t[None], method="selected-inversion")[0]


by_time = hj.devices.map_fields(without_spectrum, small, mesh)
assert difference(by_time, jax.lax.map(without_spectrum, small)) < 1e-10
assert difference(by_time[-1], signatures[-1, 0]) < 1e-5  # 60 pairs leave out little at t = 0.02

# %% [markdown]
# ## The eigenpairs of one field
#
# The Chebyshev filter takes whole functions, Rayleigh–Ritz takes all functions on a part of the grid: twice a round the
# vectors are dealt anew. They come back in slabs across the first axis, one on each device.

# %%
box = hj.Grid((2 * mesh.size, 8, 6), 0.1)
u = np.moveaxis(box.nodes, -1, 0)
factor = np.exp(0.5 * np.sin(3 * u[0]) * np.cos(2 * u[1] + u[2]))
field = hj.TensorField(box, factor[..., None, None] * np.diag([1.0, 2.0, 0.5]))
together = hj.eigenpairs(field, 12, solver=hj.ChebyshevFilter(block=4, mesh=mesh))
one = hj.eigenpairs(field, 12, solver="dense")
print(together.summary())
parts = together.eigenfunctions.addressable_shards
print(f"eigenfunctions {together.eigenfunctions.shape} in {len(parts)} slabs {parts[0].data.shape}")
assert parts[0].data.shape == (12, 2, 8, 6)
assert together.converged.all()
assert difference(together.eigenvalues, one.eigenvalues) < 1e-9
assert difference(hj.hks(together, [0.1, 1.0]), hj.hks(one, [0.1, 1.0])) < 1e-8

# %% [markdown]
# ## Space
#
# For a field larger than a device: slabs of the grid, and two planes of nodes exchanged at every product with the
# stiffness matrix. Here for columns of the heat kernel. Heat does not get eight nodes far in this time, so that sources
# eight nodes apart share a column, and 512 columns hold the signature of all nodes.

# %%
tall = hj.Grid((5 * mesh.size - 2, 16, 10), 1.0)  # the last slab is padded
u = np.moveaxis(tall.nodes, -1, 0)
layered = hj.TensorField(tall, (1.5 + 0.5 * np.sin(0.4 * u[0]))[..., None, None] * np.eye(3))
pencil = hj.assemble(layered, mass="lumped")
row_sums = np.asarray(pencil.mass.entries).reshape(tall.shape)
colour = np.ravel_multi_index(np.indices(tall.shape) % 8, (8, 8, 8))
sources = (colour[..., None] == np.arange(512)) / row_sums[..., None]
time = 0.5


def columns_on(mesh):
    slabs = hj.devices.Slabs(mesh, tall.shape, pencil.space.periodic)
    K, D, start = slabs.split(pencil.stiffness.coefficients, 1), slabs.split(row_sums), slabs.split(sources)
    return slabs, slabs.join(hj.devices.heat_columns(slabs, K, D, start, [time]), 1)[0]


slabs, heat = columns_on(mesh)
of_nodes = np.take_along_axis(np.asarray(heat), colour[..., None], axis=-1)[..., 0]
assert difference(heat, columns_on(alone)[1]) < 1e-12
assert difference(of_nodes, hj.hks_spectrum_free(pencil, [time], tolerance=1e-6)[0]) < 1e-5

# %% [markdown]
# ## What each device does
#
# Flops of one device's program for a stencil product, as the compiler counts them, and the planes that it sends. The
# first divides by the number of devices, the second does not: a slab has two neighbours however thin it is.

# %%
sizes = [p for p in (1, 2, 4, 8) if p <= mesh.size]
flops, sent = [], []
for p in sizes:
    part = hj.devices.Slabs(jax.sharding.Mesh(np.array(devices[:p]), ("devices",)), (8 * 16, 16, 10), (False,) * 3)
    shapes = [jax.ShapeDtypeStruct(shape, float) for shape in ((27, *part.padded_shape), (*part.padded_shape, 16))]
    compiled = jax.jit(part.product).lower(*shapes).compile()
    flops.append(compiled.cost_analysis()["flops"])
    sent.append(2 * int(np.prod(part.local_shape[1:])) * 16 if p > 1 else 0)
    print(f"{p} devices: {flops[-1] / 1e6:.1f} Mflop each, {sent[-1]} numbers sent by an inner one")
assert np.allclose(np.array(flops) * sizes, flops[0], rtol=0.01)

# %%
figure = hj.plot.new_figure(11, 3.6)
batches, space, work = figure.subplots(1, 3)
for shard in signatures.addressable_shards:
    first = shard.index[0].start
    batches.add_patch(Rectangle((shard.device.id - 0.45, first - 0.45), 0.9, 1.9, facecolor="tab:blue", alpha=0.6))
    batches.text(shard.device.id, first + 0.5, f"{first}, {first + 1}", ha="center", va="center", fontsize="x-small")
batches.set(xlim=(-0.7, mesh.size - 0.3), ylim=(-1, 2 * mesh.size), xlabel="device", ylabel="metric")
batches.set_title("a batch")
hj.plot.scalar_image(space, of_nodes[:, :, 5], hj.Grid(tall.shape[:2], 1.0), colorbar=False)
edges = slabs.thickness * np.arange(1, mesh.size) - 0.5
space.vlines(edges, *space.get_ylim(), colors="white", linewidth=1.5)
for index in range(mesh.size):
    space.text(slabs.thickness * (index + 0.4), 16.5, str(index), ha="center", va="bottom")
space.set_title("the signature in slabs\n")
work.plot(sizes, np.array(flops) / 1e6, "o-", label="Mflop")
work.plot(sizes, np.array(sent) / 1e3, "s--", label="thousands of numbers sent")
work.set(xscale="log", yscale="symlog", xlabel="devices", ylim=(0, None))
work.set_xticks(sizes, [str(p) for p in sizes])
work.minorticks_off()
work.legend(frameon=False, fontsize="small")
work.set_title("one device, one stencil product")
assert len(batches.patches) == mesh.size
assert edges[-1] < tall.shape[0] <= slabs.padded_shape[0]
hj.plot.save_figure(figure, "devices.png")

# %% [markdown]
# ## On GPUs
#
# - **dtype.** JAX's default is float32, and so is the library's: signatures to about 1e-3. `jax_enable_x64` makes it
#   float64, which many GPUs compute far more slowly; the Chebyshev filter runs its polynomials in float32 either way,
#   and corrects by residuals.
# - **Solvers.** `"shift-invert"` works on the host, where the vectors then travel. `"dense"`, `"block-lanczos"` (2D)
#   and `"chebyshev-filter"` (3D) stay on the device. `"auto"` does not look at the device: name the solver.
# - **jit.** One `jax.jit` around everything, from tensors to loss, keeps all values on the device. Compiling takes
#   seconds; `jax_compilation_cache_dir` keeps what was compiled.
# - **Memory.** JAX takes three quarters of it at the start; `XLA_PYTHON_CLIENT_PREALLOCATE=false` stops that. An
#   eigensolver wants two to three copies of its vectors, which docs/devices.md counts.
