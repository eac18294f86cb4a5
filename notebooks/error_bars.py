# %% [markdown]
# # Error bars, from the scan to the map
#
# The noise of a scan causes noise in the tensors and in their signatures. This notebook propagates the covariance of
# a tensor fit to the heat kernel signature. It computes the standard deviation, the bias, and the part of each map
# that noise alone can explain. The scan is simulated, so the truth is known, and we check every step.

# %%
import tempfile
import warnings
from pathlib import Path

import jax
import nibabel as nib
import numpy as np

import hks_jax as hj
from hks_jax.domain.examples import phantom

jax.config.update("jax_enable_x64", True)

# %% [markdown]
# ## The scan
#
# The scan has 20 directions with b = 1000 s/mm² and 4 images without weighting. The noise is 3 % of the signal
# without weighting.

# %%
rng = np.random.default_rng(0)
truth, mask, spacing = phantom((34, 40, 3))
u = rng.standard_normal((24, 3))
u /= np.linalg.norm(u, axis=1, keepdims=True)
b = np.where(np.arange(24) < 4, 0.0, 1000.0)
signal = 1000 * np.exp(-b * np.einsum("na,xyzab,nb->xyzn", u, truth, u)) * np.where(mask, 1.0, 0.01)[..., None]


def scan(folder: Path, rng: np.random.Generator) -> hj.io.TensorVolume:
    """Simulate one scan, and fit the tensors."""
    images = np.abs(signal + 30 * rng.standard_normal(signal.shape)).astype(np.float32)
    nib.save(nib.Nifti1Image(images, np.diag([*spacing, 1.0])), folder / "dwi.nii.gz")
    np.savetxt(folder / "b", b[None])
    np.savetxt(folder / "u", (u * [-1.0, 1.0, 1.0]).T)
    return hj.io.fit_dwi(folder / "dwi.nii.gz", folder / "b", folder / "u", mask, noise="residuals").slice("z", 1)


folder = Path(tempfile.mkdtemp())
plane, again = scan(folder, rng), scan(folder, rng)
print(*plane.notes, sep="\n")

# %% [markdown]
# `noise="residuals"` estimates the noise of the tensors from the residuals of the fit. In each voxel, the covariance
# should be half of the covariance of the difference of two scans:

# %%
grid = plane.grid("largest")
inside = grid.inside
noise = plane.noise(grid)
two = hj.TensorNoise.from_scans(plane.tensors, again.tensors, grid)
stated, seen = (np.median(np.trace(each.covariance[inside], axis1=-2, axis2=-1)) for each in (plane, two))
print(f"variance of a tensor: by residuals {stated:.3g}, by two scans {seen:.3g}; shared over {two.correlation:.2g} mm")
assert 0.75 < stated / seen < 1.33

# %% [markdown]
# ## The map
#
# The function maps the measured tensors to the signature at fixed times. We compute its error bars.

# %%
diffusivity = float(np.median(np.trace(plane.tensors, axis1=-2, axis2=-1)[inside])) / 2
times = (np.array([1.5, 2.5, 4.0, 7.0]) * plane.spacing[0]) ** 2 / diffusivity


@jax.jit
def signature(D):
    field = hj.TensorField.from_diffusion(grid, D, metric="inverse")
    return hj.hks(hj.eigenpairs(field, 150, "mean"), times, "flat")


with warnings.catch_warnings():
    warnings.simplefilter("ignore", hj.AccuracyWarning)  # the summary contains them
    bars = hj.uncertainty(signature, plane.tensors, noise, draws=32)
print(bars.summary())
print("signal to noise:", np.round(bars.signal_to_noise, 1), " claimed:", bars.trusted)

# %% [markdown]
# The second scan checks the error bars: the difference of the two maps should have √2 times the standard deviation.
# At large t a map has few independent regions. The ratio from one pair of scans is then uncertain by a factor of
# two or three.

# %%
difference = np.asarray(signature(again.tensors) - bars.value)
ratio = np.nanvar(difference, axis=(1, 2)) / (2 * np.nanmean(bars.deviation**2, axis=(1, 2)))
print("variance of the difference over the predicted one:", np.round(ratio, 2))
assert np.all((ratio > 1 / 3) & (ratio < 3))

# %% [markdown]
# The picture fades values to grey if noise explains their difference from the signature of constant tensors on the
# same domain. Noise alone leaves 5 % of the nodes without grey. `discoveries` declares nodes so that at most 5 % of the
# declared nodes are expected to be false.

# %%
figure = hj.plot.hks_panels(bars.value, times, grid, centre=1.0, z=bars.z(), unit="s", quantiles=(0.01, 0.99))
hj.plot.save_figure(figure, "error-bars.png")
print("declared at each t:", bars.discoveries(0.05).sum(axis=(1, 2)), "of", inside.sum())

# %% [markdown]
# ## A region's mean
#
# The mean of a region is one number for each time. One reverse-mode product per number gives its standard deviation,
# exact to first order. It is much more accurate than the standard deviation at a node.


# %%
region = inside & (np.hypot(*(np.indices(grid.shape) - np.array(grid.shape)[:, None, None] / 2)) < 6)
mean = hj.uncertainty(lambda D: signature(D)[:, region].mean(axis=1), plane.tensors, noise)
low, high = mean.interval(0.95)
true = signature(truth[:, :, 1, :2, :2])[:, region].mean(axis=1)
for t, value, deviation, a, z, exact in zip(times, mean.value, mean.deviation, low, high, true, strict=True):
    print(f"t = {t:.3g} s: {value:.4f} ± {deviation:.4f}, 95 % {a:.4f} … {z:.4f}, true {exact:.4f}")
assert mean.method == "exact"

# %% [markdown]
# ## Smoothing
#
# Log-Euclidean smoothing of the tensors reduces noise and bias. `smear` estimates the change of the map that the
# smoothing causes.

# %%
smooth = hj.uncertainty(signature, plane.tensors, noise, draws=16, method="resample", smoothing=0.7 * plane.spacing[0])
for name, each in (("as measured", bars), ("smoothed", smooth)):
    print(f"{name}: deviation {np.sqrt(np.nanmean(each.deviation**2, axis=(1, 2))).round(4)}")
print("smear:", np.sqrt(np.nanmean(np.square(smooth.smear), axis=(1, 2))).round(4))
assert np.nanmean(smooth.deviation[0]) < 0.7 * np.nanmean(bars.deviation[0])
