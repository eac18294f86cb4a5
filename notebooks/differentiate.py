# %% [markdown]
# # Differentiate the heat kernel signature
#
# How does the signature at one point depend on each tensor of the field? One gradient has all these derivatives.

# %%
import jax
import jax.numpy as jnp
import numpy as np

import hks_jax as hj

jax.config.update("jax_enable_x64", True)

grid = hj.Grid.from_bounds(-2.0, 2.0, shape=(41, 41))
k, x0 = 120, (26, 20)


def bump(u):  # a hill in the middle of a flat square
    return (1 + 3 * jnp.exp(-2 * (u @ u))) * jnp.eye(2)


tensors = hj.TensorField.from_function(bump, grid).tensors
times = jnp.array([0.15, 0.6])


def signature(tensors):
    pairs = hj.eigenpairs(hj.TensorField(grid, tensors), k, multiplet="complete")
    return hj.hks(pairs, times)[:, *x0]


# %% [markdown]
# The field has the symmetries of the square, so many eigenvalues have multiplicity two. Differentiating `eigh` gives
# NaN here. The derivative of the signature is exact, because it does not depend on the basis that a solver returns.

# %%
gradients = jax.jacrev(signature)(tensors)  # (2, 41, 41, 2, 2)

# %% [markdown]
# Compare the derivative in one direction with finite differences:

# %%
rng = np.random.default_rng(0)
noise = rng.standard_normal(tensors.shape)
direction = 0.1 * (noise + np.swapaxes(noise, -1, -2))
step = 1e-4
difference = (signature(tensors + step * direction) - signature(tensors - step * direction)) / (2 * step)
slope = jax.jvp(signature, (tensors,), (direction,))[1]
print("forward", slope, "reverse", jnp.vdot(gradients[0], direction), "difference", difference)
assert np.allclose(slope, difference, rtol=1e-5)
assert np.allclose(jnp.einsum("tijab,ijab->t", gradients, direction), slope, rtol=1e-9)

# %% [markdown]
# In the picture, a bar is red where increasing the length along the bar raises HKS(t, x₀), and blue where it lowers
# HKS(t, x₀). On rays from x₀, longer distances keep the heat near x₀. Perpendicular to the rays, longer distances
# give the heat more room. The affected region grows with t.

# %%
figure = hj.plot.new_figure(10, 4.6)
for ax, t, gradient in zip(figure.subplots(1, 2), times, gradients, strict=True):
    hj.plot.sensitivity(ax, grid, gradient, every=2)
    ax.plot(*grid.nodes[x0], "o", color="black", markersize=4)
    ax.set_title(f"derivative of HKS(t, x₀), t = {float(t):g}")
hj.plot.save_figure(figure, "sensitivity.png")
