# %% [markdown]
# # Train a network through the signature
#
# The input of the network is the heat kernel signature of a domain. Its output is a metric: an SPD tensor at every
# node. The training uses no true metric. The loss compares the signature of the output with the input signature, and
# the gradient passes through the eigenpairs of a batch of fields. This notebook needs optax.

# %%
import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax

import hks_jax as hj

jax.config.update("jax_enable_x64", True)

grid = hj.Grid.from_bounds(-1.0, 1.0, shape=(16, 16))
k, times = 35, jnp.array([0.06, 0.12, 0.3])


def signature(tensors):  # (16, 16, 2, 2) → (3, 16, 16), 0 where it is as in the plane
    pairs = hj.eigenpairs(hj.TensorField(grid, tensors), k)
    return jnp.log(4 * jnp.pi * times[:, None, None] * hj.hks(pairs, times))


# %% [markdown]
# The training data are signatures of metrics with smooth bumps at random positions.

# %%
rng = np.random.default_rng(0)


def random_metric():  # e^u I with three smooth bumps in u
    u = np.zeros(grid.shape)
    for _ in range(3):
        centre, width, height = rng.uniform(-0.8, 0.8, 2), rng.uniform(0.25, 0.5), rng.uniform(-0.8, 0.8)
        u += height * np.exp(-np.sum((grid.nodes - centre) ** 2, axis=-1) / width**2)
    return np.exp(u)[..., None, None] * np.eye(2)


signatures = jax.jit(jax.vmap(signature))
flat = signature(jnp.broadcast_to(jnp.eye(2), (*grid.shape, 2, 2)))
seen, unseen = (signatures(jnp.stack([random_metric() for _ in range(count)])) for count in (32, 8))

# %% [markdown]
# The exponential of any symmetric matrix is SPD. `matrix_function` has exact derivatives also at equal eigenvalues.
# These occur at the start, when the network returns nearly zero and every tensor is nearly the identity.


# %%
class Network(eqx.Module):
    layers: list

    def __init__(self, key):
        sizes, keys = [len(times), 16, 16, 3], jax.random.split(key, 3)
        self.layers = [
            eqx.nn.Conv2d(a, b, 5, padding="SAME", padding_mode="REPLICATE", key=key)
            for a, b, key in zip(sizes[:-1], sizes[1:], keys, strict=True)
        ]

    def __call__(self, x):
        x = 10 * (x - flat)
        for layer in self.layers[:-1]:
            x = jax.nn.gelu(layer(x))
        a, b, c = self.layers[-1](x).reshape(3, -1)
        logarithms = jnp.stack([a, b, b, c], axis=-1).reshape(-1, 2, 2)
        return jax.vmap(lambda A: hj.matrix_function(A, jnp.exp))(logarithms).reshape(*grid.shape, 2, 2)


def loss(network, seen):
    return jnp.mean((jax.vmap(lambda x: signature(network(x)))(seen) - seen) ** 2)


# %% [markdown]
# The training step is the usual one. Only the first step compiles.

# %%
optimiser = optax.adam(1e-2)


@eqx.filter_jit(compiler_options=hj.compiler_options())
def step(network, state, seen):
    value, gradient = eqx.filter_value_and_grad(loss)(network, seen)
    updates, state = optimiser.update(gradient, state)
    return eqx.apply_updates(network, updates), state, value


network = Network(jax.random.key(0))
state = optimiser.init(eqx.filter(network, eqx.is_array))
losses, start = [], time.perf_counter()
for number in range(120):
    batch = seen[(8 * number) % 32 :][:8]
    network, state, value = step(network, state, batch)
    losses.append(float(value))
    if number == 0:
        print(f"the first step, with its compilation: {time.perf_counter() - start:.1f} s")
        start = time.perf_counter()
print(f"{(time.perf_counter() - start) / 119 * 1e3:.0f} ms a step later")

# %% [markdown]
# We measure how much of the signature the network explains, also for fields outside the training data.

# %%
before, after = jnp.mean((unseen - flat) ** 2), loss(network, unseen)
print(f"misfit of the flat metric {before:.2e}, of the network's {after:.2e}")
assert after < before / 2

# %%
predicted = signature(network(unseen[0]))
figure = hj.plot.new_figure(9.5, 5.2)
for row, name, panels in zip(figure.subplots(2, 3), ("given", "from the network"), (unseen[0], predicted), strict=True):
    for ax, t, panel in zip(row, times, panels, strict=True):
        hj.plot.scalar_image(ax, jnp.exp(panel), grid, centre=1)
        ax.set_title(f"{name}, t = {t:g}")
