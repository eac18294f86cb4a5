# %% [markdown]
# # Volumes, and small times
#
# This notebook shows the information that slices of a volume lose, and signatures at times that are too small for any
# computed spectrum.
#
# ## What slices lose
#
# The metric g = dx² + dy² + f(x, y)² dz² on a volume is curved, but all its slices z = const are flat. Only the heat
# kernel signature of the volume shows the curvature.

# %%
import warnings

import jax
import jax.numpy as jnp
import numpy as np

import hks_jax as hj

jax.config.update("jax_enable_x64", True)

n = 16
grid = hj.Grid((n, n, n), 1 / n)


def metric(u):
    f = 1 + 0.35 * jnp.cos(2 * jnp.pi * u[0]) * jnp.cos(2 * jnp.pi * u[1])
    return jnp.diag(jnp.array([1.0, 1.0, f**2]))


field = hj.TensorField.from_function(metric, grid)
plane = hj.TensorField(hj.Grid((n, n), 1 / n), field.tensors[:, :, n // 2, :2, :2])

# %% [markdown]
# The torus has no boundary, so no boundary effect hides the curvature. 180 pairs resolve t = 0.01 to a few per cent.

# %%
t = 0.01
with warnings.catch_warnings():
    warnings.simplefilter("ignore", hj.AccuracyWarning)  # k cuts a multiple eigenvalue of the flat slice
    of_slice = hj.hks(hj.eigenpairs(plane, 120, boundary="periodic"), [t])[0]
    of_volume = hj.hks(hj.eigenpairs(field, 180, boundary="periodic"), [t])[0][:, :, n // 2]


def spread(values):
    return float((values.max() - values.min()) / values.mean())


print(f"the signature varies by {spread(of_slice):.2%} in the slice, by {spread(of_volume):.1%} in the volume")
assert spread(of_slice) < 0.01
assert spread(of_volume) > 0.1

# %% [markdown]
# For small t the volume's signature is (4πt)^(−3/2) (1 + Rt/6 + …), where R is the scalar curvature; here R = −2
# ∇²f/f.

# %%
curvature = np.asarray(hj.scalar_curvature(field))[:, :, n // 2]
correlation = np.corrcoef(of_volume.ravel(), curvature.ravel())[0, 1]
print(f"correlation with the scalar curvature: {correlation:.3f}")
assert correlation > 0.95

# %%
figure = hj.plot.new_figure(10, 3.6)
pictures = (
    (of_slice, f"slice alone, t = {t}"),
    (of_volume, f"in the volume, t = {t}"),
    (curvature, "scalar curvature"),
)
for ax, (image, title) in zip(figure.subplots(1, len(pictures)), pictures, strict=True):
    hj.plot.scalar_image(ax, image, plane.grid, least_range=0.02)
    ax.set(title=title)
hj.plot.save_figure(figure, "volumes.png")

# %% [markdown]
# ## Small times without a spectrum
#
# At time t, the signature needs the eigenvalues up to about 5/t. Their number grows like 1/t in the plane and like
# t^(−3/2) in a volume. `hks_spectrum_free` computes the signature without eigenpairs. The result equals the sum over
# all eigenpairs of the grid. On a small grid we can compute them all and compare.

# %%
field = hj.examples.figure4_fields(41)["cells"]
times = np.geomspace(6e-4, 0.02, 12)
free = np.asarray(hj.hks_spectrum_free(field, times))
every = hj.eigenpairs(field, field.grid.size, solver="dense")
with warnings.catch_warnings():
    warnings.simplefilter("ignore", hj.AccuracyWarning)  # the bias of the grid, which is shown below
    of_all = hj.hks(every, times)
print(f"spectrum-free against all {every.k} pairs: {np.abs(free / of_all - 1).max():.1e}")
assert np.allclose(free, of_all, rtol=1e-4)

# %% [markdown]
# The sum over a truncated spectrum is too small, by more than half at the smallest time. A warning reports this
# error.

# %%
k = 100
pairs = hj.eigenpairs(field, k, multiplet="drop")
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    truncated = np.asarray(hj.hks(pairs, times))
limit = float(hj.truncation(pairs, times).smallest_time)
print(caught[0].message)
assert "too small for k" in str(caught[0].message)
lacking = 1 - (truncated / free).mean(axis=(1, 2))
print(f"{k} pairs lack {lacking[0]:.0%} at t = {times[0]:.2g}, {lacking[-1]:.2%} at t = {times[-1]:.2g}")
assert lacking[0] > 0.5
assert lacking[times > 1.2 * limit].max() < 0.01

# %% [markdown]
# Colouring, the method for volumes, has an error bound. Heat starts at many nodes at once, so far apart that it does
# not reach the next source. This cell compares colouring with selected inversion, which is exact to ten digits. Both
# use the lumped mass, for which colouring is fast.

# %%
small = times[:4]
settings = hj.colouring(field, small, mass="lumped", tolerance=1e-4)
coloured = hj.hks_spectrum_free(field, small, mass="lumped", method=settings)
exact = hj.hks_spectrum_free(field, small, mass="lumped", method="selected-inversion")
error = np.asarray(jnp.abs(coloured - exact).max(axis=(1, 2))) * 4 * np.pi * small
print(f"sources {settings.spacing} nodes apart, degree {settings.degree}")
print("bound", np.array(settings.error), "error", error)
assert np.all(error < settings.error)
assert max(settings.error) < 1e-4

# %% [markdown]
# At such times the signature agrees with its expansion, 4πt·HKS = 1 + Kt/3 + …, from which the curvature can be
# computed. At still smaller times the spacing h of the grid causes a bias of up to 0.06 h²/t. This bias comes from
# the grid and not from the method. A finer grid moves it to smaller times.

# %%
series = np.asarray(hj.hks_expansion(field, times, order=2))
points = [(0.5, 0.5), (0.5, 0.25)]
figure = hj.plot.new_figure(10, 3.8)
left, right = figure.subplots(1, 2, sharey=True)
for ax, values, title in ((left, truncated, f"{k} eigenpairs"), (right, free, "without a spectrum")):
    shown = limit if ax is left else None
    hj.plot.hks_curves(ax, values, times, field.grid, points, expansion=series, limit=shown, scaled=True)
    ax.set(title=title, ylim=(0.6, 1.2))
width = 2 / 40  # the spacing where the metric is largest
bias = np.abs(4 * np.pi * times * (free - series)[:, 20, 20])
print("spectrum-free, without the expansion:", np.round(bias, 3))
assert np.all(bias < 0.06 * width**2 / times + 0.005)
assert [len(ax.lines) for ax in (left, right)] == [4, 4]
hj.plot.save_figure(figure, "small-times.png")
