# %% [markdown]
# # Fit a metric: a hole in a brain slice
#
# In a part of a slice the diffusion tensors are missing. The heat kernel signature at a few times is given, with
# noise. We compute tensors that have this signature.

# %%
import importlib.util

import jax
import numpy as np

import hks_jax as hj
from hks_jax.domain.examples import phantom

jax.config.update("jax_enable_x64", True)

# %% [markdown]
# The brain data come from the PyPI wheel `mdt` (`pip install --no-deps mdt==1.2.7`). If the wheel is not installed,
# we use a phantom. A window of the slice suffices; it contains the fibres that connect the hemispheres, and the
# ventricles.

# %%
brain = hj.io.find_example_brain() if importlib.util.find_spec("dipy") else None
if brain is not None:
    volume = hj.io.fit_dwi(brain.images, brain.bval, brain.bvec, brain.mask, b_max=1000.0).slice("z", 0)
    window = (slice(34, 74), slice(54, 92))
    tensors, spacing = volume.tensors[window], volume.spacing
    mask = hj.io.erode(volume.mask, 2)[window]
    centre, radius = (24.0, 38.0), 9.0  # mm
else:
    tensors, mask, spacing = phantom((34, 40))
    centre, radius = (45.0, 105.0), 19.0
D = 1e3 * tensors  # in 10⁻³ mm²/s; the unit of t is then 1000 s
grid = hj.Grid(mask.shape, spacing, mask=mask, components="largest")
truth = hj.TensorField.from_diffusion(grid, D, metric="inverse")

# %% [markdown]
# The hole is a disc on the left. The initial tensor in the hole is the isotropic mean of the rest of the slice.

# %%
x, y = grid.nodes[..., 0], grid.nodes[..., 1]
hole = (np.hypot(x - centre[0], y - centre[1]) < radius) & grid.inside
known = grid.inside & ~hole
mean = np.trace(D[known].mean(axis=0)) / 2 * np.eye(2)
init = hj.TensorField.from_diffusion(grid, np.where(hole[..., None, None], mean, D), metric="inverse")

k, noise = 220, 0.005
smallest = (2.2 * max(grid.spacing)) ** 2 / np.median(D[known][:, [0, 1], [0, 1]])
times = smallest * np.geomspace(1.0, 15.0, 5)
exact = hj.hks(hj.eigenpairs(truth, k), times)
rng = np.random.default_rng(0)
target = exact * np.exp(noise * rng.standard_normal(exact.shape))

# %%
fit = hj.fit_metric(init, target, times, data=hj.inverse.Data(noise=noise), k=k, progress=print)
print(fit)


def error(field):
    difference = np.linalg.norm(field.tensors - truth.tensors, axis=(-2, -1))[hole]
    return np.sqrt((difference**2).sum() / (np.linalg.norm(truth.tensors, axis=(-2, -1))[hole] ** 2).sum())


print(f"error in the hole: {error(init):.1%} before, {error(fit.field):.1%} after")
assert fit.converged
assert error(fit.field) < 0.7 * error(init)

# %% [markdown]
# The figure shows the truth, the start and the fit around the hole. Most of the fibres reappear.

# %%
figure = hj.plot.new_figure(13, 5)
for ax, field, title in zip(figure.subplots(1, 3), (truth, init, fit.field), ("truth", "start", "fit"), strict=True):
    hj.plot.ellipses(ax, field, every=1, sizes="fit", color="anisotropy", colorbar=title == "fit")
    reach = 1.35 * radius
    ax.set(xlim=(centre[0] - reach, centre[0] + reach), ylim=(centre[1] - reach, centre[1] + reach))
    ax.set(title=title, xlabel="mm")
hj.plot.save_figure(figure, "fit.png")
