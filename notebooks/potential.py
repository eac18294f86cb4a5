# %% [markdown]
# # Recover a potential from a signature
#
# A particle moves on a curved surface in a potential V. We know the heat kernel signature of −Δ + V at a few times,
# with noise, and recover the potential.

# %%
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

import hks_jax as hj

jax.config.update("jax_enable_x64", True)

n, k = 21, 60
grid = hj.Grid.from_bounds(-1.0, 1.0, shape=(n, n))


def hill(x):  # the metric of a hill: a graph over the plane
    slope = jax.grad(lambda x: 0.5 * jnp.exp(-4 * x @ x))(x)
    return jnp.eye(2) + jnp.outer(slope, slope)


field = hj.TensorField.from_function(hill, grid)
x, y = np.moveaxis(grid.nodes, -1, 0)
truth = -60 * np.exp(-12 * ((x - 0.4) ** 2 + y**2)) + 40 * np.exp(-16 * ((x + 0.3) ** 2 + (y - 0.3) ** 2))

# %% [markdown]
# The well has a bound state: one eigenvalue is negative. The inertia proves that no eigenvalue is missing.

# %%
pairs = hj.eigenpairs(hj.assemble(field, potential=truth), k, multiplet="complete")
print(pairs.summary())
times = [0.03, 0.06, 0.12]
rng = np.random.default_rng(0)
noise = 0.01
target = hj.hks(pairs, times) * np.exp(noise * rng.standard_normal((len(times), n, n)))
assert pairs.eigenvalues[0] < 0 < pairs.eigenvalues[1]

# %% [markdown]
# The potential is the solution of a least-squares problem, which Levenberg–Marquardt of optimistix solves. The
# residuals are differences of the signature's logarithm and a penalty on differences between neighbouring values,
# because the potential is smooth. The unknowns are values on a coarser grid, which are interpolated.

# %%
coarse = 9
hats = np.maximum(0, 1 - np.abs(np.linspace(0, coarse - 1, n)[:, None] - np.arange(coarse)))  # (n, coarse)


def potential(unknowns):
    return hats @ unknowns @ hats.T


@jax.jit
def residuals(unknowns, target):
    pencil = hj.assemble(field, potential=potential(unknowns))
    signature = hj.hks(hj.eigenpairs(pencil, k, solver="dense"), times)
    rough = [jnp.diff(unknowns, axis=axis).ravel() for axis in (0, 1)]
    return jnp.concatenate([(jnp.log(signature / target) / noise).ravel(), *(0.05 * each for each in rough)])


solver = optx.LevenbergMarquardt(rtol=1e-4, atol=1e-4)
start = jnp.zeros((coarse, coarse))
found = optx.least_squares(residuals, solver, start, target, options={"jac": "fwd"}, max_steps=30, throw=False)
recovered = potential(found.value)


def error(V):
    return float(jnp.linalg.norm(V - truth) / jnp.linalg.norm(truth))


print(f"{int(found.stats['num_steps'])} steps; error {error(recovered):.1%} of the potential")
assert error(recovered) < 0.2

# %% [markdown]
# The figure shows the true potential, the recovered potential, and the lowest eigenfunction, which is localised in
# the well:

# %%
figure = hj.plot.new_figure(12, 3.6)
ground = hj.eigenpairs(hj.assemble(field, potential=recovered), 1).eigenfunctions[0]
for ax, values, title in zip(
    figure.subplots(1, 3), (truth, recovered, jnp.abs(ground)), ("potential", "recovered", "ground state"), strict=True
):
    picture = ax.imshow(np.asarray(values).T, origin="lower", extent=grid.extent)
    figure.colorbar(picture, ax=ax)
    ax.set_title(title)
hj.plot.save_figure(figure, "potential.png")
