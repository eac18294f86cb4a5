# %% [markdown]
# # Several devices
#
# Batches, times and eigenvectors can be distributed over the devices of a mesh with one axis. The results
# equal those of one device up to rounding. If there is only one CPU, JAX presents it as eight devices here. This
# shows the distribution of data, but does not make the computation faster.

# %%
import os

# Set this flag before JAX starts. It affects only the CPU.
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


def difference(a, b):  # the largest difference, relative to the largest value
    a, b = np.asarray(a), np.asarray(b)
    return float(np.abs(a - b).max() / np.abs(b).max())


# %% [markdown]
# ## Batches
#
# The batch contains metrics on one grid, two for each device, from a flat metric to a wavy one. Nothing is exchanged.

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
# With selected inversion, the computations for different times are independent.

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
# The Chebyshev filter works on whole functions, and Rayleigh–Ritz works on all functions on a part of the grid. The
# vectors are therefore redistributed twice per round. The result consists of slabs across the first axis, one on each
# device.

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

# %%
figure = hj.plot.new_figure(8, 3.6)
batches, space = figure.subplots(1, 2)
for shard in signatures.addressable_shards:
    first = shard.index[0].start
    batches.add_patch(Rectangle((shard.device.id - 0.45, first - 0.45), 0.9, 1.9, facecolor="tab:blue", alpha=0.6))
    batches.text(shard.device.id, first + 0.5, f"{first}, {first + 1}", ha="center", va="center", fontsize="x-small")
batches.set(xlim=(-0.7, mesh.size - 0.3), ylim=(-1, 2 * mesh.size), xlabel="device", ylabel="metric")
batches.set_title("a batch")
hj.plot.scalar_image(space, hj.hks(together, [0.1])[0, :, :, 3], hj.Grid(box.shape[:2], 0.1), colorbar=False)
space.vlines(0.1 * (2 * np.arange(1, mesh.size) - 0.5), *space.get_ylim(), colors="white", linewidth=1.5)
for index in range(mesh.size):
    space.text(0.1 * (2 * index + 0.5), 0.77, str(index), ha="center", va="bottom")
space.set_title("the signature in slabs\n")
assert len(batches.patches) == mesh.size
hj.plot.save_figure(figure, "devices.png")

# %% [markdown]
# ## On GPUs
#
# - **dtype.** The default of JAX and of this library is float32, with errors of about 1e-3 in signatures.
#   `jax_enable_x64` selects float64, in which many GPUs are far slower. The Chebyshev filter always evaluates its
#   polynomials in float32, and corrects the result with residuals.
# - **Solvers.** `"dense"`, `"block-lanczos"` (2D) and `"chebyshev-filter"` (3D) run on the device. `"shift-invert"`
#   runs on the host and requires transfers. `"auto"` never chooses it on a GPU.
# - **jit.** If one `jax.jit` contains all steps from tensors to loss, all values stay on the device. Compilation
#   takes seconds; `jax_compilation_cache_dir` stores the compiled programs.
# - **Memory.** JAX allocates three quarters of the memory at the start; `XLA_PYTHON_CLIENT_PREALLOCATE=false`
#   prevents this. An eigensolver needs two to three times the memory of its vectors (see docs/devices.md).
