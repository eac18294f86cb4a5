# %% [markdown]
# # Maps in the modes of a brain
#
# The modes of a slice of white and grey matter are the eigenfunctions of diffusion in it. This notebook computes them
# for the brain of `hks-jax demo`, or for a phantom if the brain is not installed, and writes a map as a sum of modes.

# %%
import importlib.util

import jax
import jax.numpy as jnp
import numpy as np

import hks_jax as hj

jax.config.update("jax_enable_x64", True)

brain = hj.io.find_example_brain()
if brain is not None and importlib.util.find_spec("dipy") is not None:
    scan = hj.io.fit_dwi(brain.images, brain.bval, brain.bvec, brain.mask, b_max=1000).slice("z", 0)
    grid = scan.with_mask(hj.io.erode(scan.inside, 2)).grid("largest")
    tensors = scan.tensors
else:
    tensors, mask, spacing = hj.examples.phantom((72, 80))
    grid = hj.Grid(mask.shape, spacing, mask=mask, components="largest")
inside = grid.inside
print(inside.sum(), "voxels of", np.round(grid.spacing, 2), "mm")

# %% [markdown]
# ## Modes and their wavelengths
#
# Fick's operator −div(D∇) has the tensors D as they are measured, and the mass matrix is that of the plain area. The
# first mode is constant. The eigenvalue λ stands for the wavelength 2π√(d/λ), with the mean diffusivity d.

# %%
field = hj.TensorField.from_diffusion(grid, tensors, operator="fick")
pairs = hj.eigenpairs(field, k=200, multiplet="drop")
f = np.where(inside, np.nan_to_num(hj.tensor_invariants(hj.TensorField(grid, tensors))["anisotropy"]), 0)
found = hj.energy(pairs, f)
print("wavelengths of the modes 2, 10, 50, 200, in mm:", np.round(found.wavelength[np.array([1, 9, 49, -1])], 1))
assert found.wavelength[1] > 60  # the first modes span the whole slice
assert (np.diff(found.wavelength) <= 0).all()

# %% [markdown]
# ## One map through ten, fifty, two hundred modes
#
# The map is the anisotropy of the tensors. The share of its variance that the modes explain grows with their
# number. The rest varies within fewer millimetres than the shortest wavelength.

# %%
c = hj.decompose(pairs, f)
counts = (10, 50, pairs.k)
partial = [np.asarray(hj.reconstruct(pairs, c[:m])) for m in counts]
explained = [float(found.explained[m - 1]) for m in counts]
for m, share in zip(counts, explained, strict=True):
    print(f"{m:3d} modes explain {share:.1%} of the variance")
assert explained[0] < explained[1] < explained[2] < 1
np.testing.assert_allclose(found.energy.sum() + found.residual[-1], found.total)  # Parseval

# %% [markdown]
# A mode follows the tissue, because diffusion is faster along fibres. The plain dot product of two modes need not
# vanish; the inner product with the mass does.

# %%
phi = pairs.vectors
off = ~np.eye(pairs.k, dtype=bool)
lengths = jnp.linalg.norm(phi, axis=1)
plain = np.abs(np.asarray(phi @ phi.T / jnp.outer(lengths, lengths)))[off].max()
proper = np.abs(np.asarray(phi @ (pairs.pencil.mass @ phi.T)))[off].max()
print(f"greatest cosine of the angle between two modes: plain {plain:.2f}, with the mass {proper:.0e}")
assert proper < 1e-10

# %%
figure = hj.plot.new_figure(12, 6.6)
axes = figure.subplots(2, 4)
modes = np.asarray(pairs.eigenfunctions)
for ax, number in zip(axes[0], (1, 5, 20, 100), strict=True):
    limit = float(np.nanquantile(np.abs(modes[number]), 0.99))
    hj.plot.scalar_image(ax, modes[number], grid, cmap="RdBu_r", vmin=-limit, vmax=limit, colorbar=False)
    ax.set_title(f"mode {number + 1}: {float(found.wavelength[number]):.0f} mm", fontsize="medium")
shown = [*partial, np.where(inside, f, np.nan)]
titles = [f"{m} modes: {share:.0%}" for m, share in zip(counts, explained, strict=True)] + ["anisotropy"]
low, high = np.nanquantile(shown[-1], [0.01, 0.99])
for ax, values, title in zip(axes[1], shown, titles, strict=True):
    hj.plot.scalar_image(ax, values, grid, vmin=low, vmax=high, colorbar=False)
    ax.set_title(title, fontsize="medium")
hj.plot.save_figure(figure, "modes.png")

# %% [markdown]
# ## A filter, and null maps
#
# The filter exp(−λt) is heat flow. Surrogates keep the energy of each group of modes. Groups of twenty
# neighbouring modes make them more different from the map than changes of sign would.

# %%
t = float(np.log(2) / pairs.eigenvalues[50])  # halves mode 51
smooth = hj.spectral_filter(pairs, f, lambda t, x: jnp.exp(-t * x), jnp.array([t]))[0]
inner = hj.reconstruct(pairs, c)
nulls = hj.surrogates(pairs, inner, jax.random.key(0), n=100, groups=np.arange(pairs.k) // 20)
energies = np.asarray(hj.decompose(pairs, nulls)) ** 2
for group in range(1, pairs.k // 20):
    own = np.arange(pairs.k) // 20 == group
    np.testing.assert_allclose(energies[:, own].sum(1), float((c[own] ** 2).sum()), rtol=1e-8)
correlations = [np.corrcoef(one[inside], np.asarray(inner)[inside])[0, 1] for one in np.asarray(nulls)]
print(f"correlations of 100 null maps with the map: {np.mean(correlations):.2f} ± {np.std(correlations):.2f}")
assert np.abs(np.mean(correlations)) < 0.3
