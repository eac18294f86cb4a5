# %% [markdown]
# # The paper, figure by figure
#
# This notebook reproduces V. Zobel, J. Reininghaus and I. Hotz, *Visualization of Two-Dimensional Symmetric Positive
# Definite Tensor Fields Using the Heat Kernel Signature* (2014), at sizes that take two minutes in all. `python
# benchmarks/paper/reproduce.py` writes the table and the figures at larger sizes, and with `--full` at the paper's
# sizes. The last part compares the signature with smoothed scalars, which the paper's outlook proposes.

# %%
import importlib.util
import math
import warnings
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from scipy.ndimage import map_coordinates

import hks_jax as hj
from hks_jax.domain.examples import phantom

jax.config.update("jax_enable_x64", True)


@partial(jax.jit, static_argnums=(0, 3, 4))  # compiling one function per grid is faster than compiling its parts
def heat(grid, tensors, times, k, boundary="neumann", functions=None):
    """Return 4πt·HKS, and the given functions after heat flow."""
    pairs = hj.eigenpairs(hj.TensorField(grid, tensors), k, boundary)
    return hj.hks(pairs, times, "flat"), None if functions is None else hj.heat_flow(pairs, times, functions)


# %% [markdown]
# ## Table 1 and Figure 1: a surface and its metric
#
# The surface is a bumpy torus, given as a triangulation in space. Its metric in the parameter domain is a tensor
# field on a grid. The signature depends only on the metric, so both have the same signature up to discretisation
# errors. We compare the metric on n² nodes with a surface of 200² vertices; the paper's surface has 400².

# %%
time, size = jnp.array([1.0]), 200
reference = np.asarray(hj.hks(hj.eigenpairs(hj.examples.bumpy_torus_mesh(size), 99), time))[0].reshape(size, size)
of_metric, differences = {}, {}
for n, of_paper in ((50, 0.384), (100, 0.0760)):
    field = hj.examples.bumpy_torus_field(n)
    values = np.asarray(heat(field.grid, field.tensors, time, 100, "periodic")[0][0]) / (4 * np.pi)
    fine = map_coordinates(values, np.indices((size, size)) * n / size, order=1, mode="grid-wrap")
    of_metric[n], differences[n] = values, np.linalg.norm(fine - reference) / np.linalg.norm(reference)
    print(f"{n}² nodes: relative L² difference {differences[n]:.4f} (the paper: {of_paper})")
    assert differences[n] < of_paper
assert differences[50] / differences[100] > 2

# %%
mesh = hj.examples.bumpy_torus_mesh(100)
low, high = of_metric[100].min(), of_metric[100].max()
figure = hj.plot.new_figure(9.5, 4.2)
space = figure.add_subplot(1, 2, 1, projection="3d")
hj.plot.surface(space, mesh, reference[::2, ::2].ravel(), vmin=low, vmax=high, zoom=1.3)
space.set_title("HKS of the surface")
plane = figure.add_subplot(1, 2, 2)
hj.plot.scalar_image(plane, of_metric[100], field.grid, vmin=low, vmax=high, label="HKS, $t$ = 1")
plane.set(title="HKS of the metric", xlabel="$u$", ylabel="$v$")
hj.plot.save_figure(figure, "paper-figure1.png")

# %% [markdown]
# ## Figure 2: boundaries
#
# A natural boundary doubles the signature at an edge, and makes it four times as large at a corner. The paper
# reflects a strip of the field. `"mirror"` reflects the whole field, so that a flat metric shows no boundary effect.

# %%
n, k = 31, 300
square = hj.Grid.from_bounds(-5.0, 5.0, (n, n))
flat = jnp.broadcast_to(jnp.eye(2), (n, n, 2, 2))
natural, mirror = (np.asarray(heat(square, flat, time, k, side)[0][0]) for side in ("neumann", "mirror"))
d = square.axes[0] + 5
exact = 1 + np.exp(-(d**2))
print(f"natural: middle {natural[15, 15]:.3f}, edge {natural[0, 15]:.3f}, corner {natural[0, 0]:.3f}")
assert np.allclose([natural[15, 15], natural[0, 15], natural[0, 0]], [1, 2, 4], rtol=0.03)
assert np.allclose(natural[:16, 15], exact[:16], atol=0.05)
assert np.ptp(mirror) < 1e-3

figure = hj.plot.new_figure(11, 3.2)
first, second, along = figure.subplots(1, 3)
for ax, image, title in ((first, natural, "natural"), (second, mirror, "mirror")):
    hj.plot.scalar_image(ax, image, square, vmin=0.9, vmax=4, label=r"$4\pi t\,$HKS, $t$ = 1")
    ax.set_title(title)
along.plot(d, natural[:, 15], label="natural")
along.plot(d, mirror[:, 15], "--", label="mirror")
along.plot(d, exact, "k:", label="$1 + \\exp(-d^2/t)$")
along.set(xlim=(0, 5), xlabel="distance $d$ from an edge", ylabel=r"$4\pi t\,$HKS")
along.legend(frameon=False)
hj.plot.save_figure(figure, "paper-figure2.png")

# %% [markdown]
# ## Figure 3: trace and determinant vary, the signature does not
#
# T¹ = diag(f(u₁), 1) varies by a factor of eleven, but it is flat: only the scale along u₁ changes. Its signature is
# constant. The other three metrics are curved.

# %%
fields = hj.examples.figure3_fields(n)
figure = hj.plot.new_figure(14, 6.4)
images = {name: np.asarray(heat(square, field.tensors, time, k, "mirror")[0][0]) for name, field in fields.items()}
spreads = {name: float(np.ptp(image)) for name, image in images.items()}
low, high = min(image.min() for image in images.values()), max(image.max() for image in images.values())
for top, bottom, (name, field) in zip(*figure.subplots(2, 4), fields.items(), strict=True):
    last = name == "T⁴"
    hj.plot.ellipses(top, field, every=2, colorbar=last)
    hj.plot.scalar_image(bottom, images[name], square, vmin=low, vmax=high, colorbar=last, interpolation="bilinear")
    top.set_title(name)
    bottom.set_xlabel(r"$4\pi t\,$HKS, $t$ = 1")
hj.plot.save_figure(figure, "paper-figure3.png")
print("4πt·HKS varies by", {name: round(spread, 3) for name, spread in spreads.items()})
assert np.ptp(hj.tensor_invariants(fields["T¹"])["trace"]) > 9
assert spreads.pop("T¹") < 0.05
assert min(spreads.values()) > 0.15

# %% [markdown]
# ## Figure 4: the signature varies, trace and determinant do not
#
# The eigenvalues are constant. Trace, determinant and anisotropy are therefore the same at all points of all five
# fields. Straight lines, circles and spirals are flat; waves and cells are curved. The signature shows their
# curvature, 4πt·HKS = 1 + Kt/3 + …, and smoothing of constant scalars cannot show it. The formulas are extended
# beyond the domain, so that the pictures show no boundary effect.


# %%
def continued(field, width):
    grid = field.grid
    origin = [o - width * h for o, h in zip(grid.origin, grid.spacing, strict=True)]
    wide = hj.Grid([n + 2 * width for n in grid.shape], grid.spacing, origin)
    return hj.TensorField.from_function(field.function, wide)


def enough_pairs(field, t):
    """Return k such that exp(−λₖt) is about exp(−7), by Weyl's law."""
    return math.ceil(hj.weyl_count(hj.assemble(field), [7 / t], field)[0])


time, width = jnp.array([0.01]), 7
fields = hj.examples.figure4_fields(n)
figure = hj.plot.new_figure(15, 5.8)
of_flat, of_curved = [], []
for top, bottom, (name, field) in zip(*figure.subplots(2, 5), fields.items(), strict=True):
    wide = continued(field, width)
    k = enough_pairs(wide, 0.01)
    scalars = jnp.stack([jnp.asarray(scalar) for scalar in hj.tensor_invariants(wide).values()])
    (values,), (smoothed,) = heat(wide.grid, wide.tensors, time, k, functions=scalars)
    assert np.ptp(scalars, axis=(1, 2)).max() < 1e-12
    assert np.ptp(smoothed, axis=(1, 2)).max() < 1e-9
    values, curvature = values[width:-width, width:-width], hj.gaussian_curvature(field)
    if jnp.abs(curvature).max() < 1e-9:
        of_flat.append(float(np.ptp(values)))
    else:
        of_curved.append(float(np.corrcoef(values.ravel(), curvature.ravel())[0, 1]))
    hj.plot.integral_lines(top, field, density=0.7)
    hj.plot.scalar_image(bottom, values, field.grid, least_range=0.1, interpolation="bilinear")
    top.set_title(name)
    bottom.set_xlabel(r"$4\pi t\,$HKS, $t$ = 0.01")
hj.plot.save_figure(figure, "paper-figure4.png")
print("flat: 4πt·HKS varies by", np.round(of_flat, 3), "curved: correlation with K", np.round(of_curved, 3))
assert (len(of_flat), len(of_curved)) == (3, 2)
assert max(of_flat) < 0.02
assert min(of_curved) > 0.9

# %% [markdown]
# ## Figure 5: degenerate points
#
# At a degenerate point the eigenvalues are equal. Around the point, the eigenvectors rotate by multiples of a half
# turn. The signature has a different pattern for each index.

# %%
time, width, images = jnp.array([0.2]), 8, {}
for index in (-1, -0.5, 0.5, 1, 1.5):
    field = hj.examples.degenerate_point_field(index, n)
    points = hj.degenerate_points(field)
    assert points.indices.tolist() == [index]
    assert np.allclose(points.positions, 0, atol=1e-6)
    wide = continued(field, width)
    values = heat(wide.grid, wide.tensors, time, enough_pairs(wide, 0.2))[0][0]
    images[index] = values = np.asarray(values[width:-width, width:-width])
    print(f"index {index:4}: {values.min():.4f} … {values.max():.4f}")
figure = hj.plot.new_figure(14, 2.9)
low, high = np.min(list(images.values())), np.max(list(images.values()))
for ax, (index, values) in zip(figure.subplots(1, 5), images.items(), strict=True):
    field = hj.examples.degenerate_point_field(index, n)
    last = index == 1.5
    hj.plot.scalar_image(ax, values, field.grid, vmin=low, vmax=high, colorbar=last, interpolation="bilinear")
    hj.plot.integral_lines(ax, field, density=0.6, colors="white", linewidths=0.6, alpha=0.8)
    hj.plot.degenerate_points(ax, field)
hj.plot.save_figure(figure, "paper-figure5.png")

# %% [markdown]
# ## A tunnel: the effect of small perturbations
#
# Two halls are separated by a wall and connected at one end. The second domain also has a tunnel through the wall,
# one element wide. The tunnel makes distances much shorter; here we compute them by Varadhan's formula, d² = lim −4t
# log k_t as t → 0. The signature hardly changes, except near the ends of the tunnel, because little heat passes
# through it.


# %%
def halls(opening):
    mask = np.ones((37, 27), dtype=bool)
    mask[:30, 10:17] = False
    mask[5 : 6 + opening if opening else 5, 10:17] = True
    return hj.Grid(mask.shape, mask=mask)


grids, times = (halls(0), halls(1)), jnp.array([16.0, 64.0])
identity, source = jnp.broadcast_to(jnp.eye(2), (37, 27, 2, 2)), (5, 8)
spectra = [hj.eigenpairs(hj.TensorField(grid, identity), 200) for grid in grids]
signatures = [np.asarray(hj.hks(pairs, times, "flat")) for pairs in spectra]
with warnings.catch_warnings():  # some nodes are too far away for the kernel at this t
    warnings.simplefilter("ignore", hj.AccuracyWarning)
    distances = [np.asarray(hj.varadhan_distance(pairs, [40.0], source))[0, 0] for pairs in spectra]
both = grids[0].inside
changes = [np.linalg.norm((b - a)[both]) / np.linalg.norm(a[both]) for a, b in zip(*signatures, strict=True)]
print("distance across the wall:", [round(float(d[5, 18]), 1) for d in distances])
print("4πt·HKS changes by", [f"{change:.1%}" for change in changes])
assert max(changes) < 0.06
assert distances[0][5, 18] > 3 * distances[1][5, 18]

figure = hj.plot.new_figure(11, 6)
for row, grid, values, distance in zip(figure.subplots(2, 2), grids, signatures, distances, strict=True):
    hj.plot.scalar_image(row[0], values[0], grid, vmin=1, vmax=4, label=r"$4\pi t\,$HKS, $t$ = 16")
    hj.plot.scalar_image(row[1], distance, grid, vmin=0, vmax=60, label="distance from the dot")
    row[1].plot(*source, "wo", markeredgecolor="black")
hj.plot.save_figure(figure, "paper-tunnel.png")

# %% [markdown]
# ## Figure 6: a brain at several times
#
# The brain is that of `hks-jax demo`; without its wheel or DIPY, this figure is skipped. The paper uses the diffusion
# tensor as the metric, T = D, in which strong diffusion makes distances long. In the metric g = D⁻¹ strong diffusion
# makes distances short. In tissue the two signatures are nearly opposite.


# %%
def draw_brain(files):
    volume = hj.io.fit_dwi(files.images, files.bval, files.bvec, files.mask, b_max=1000).slice("z", 0)
    grid = volume.with_mask(hj.io.erode(volume.inside, 2)).grid("largest")
    orientation = hj.plot.Orientation.of(volume.volume_affine, volume.thin_axis)
    turned = orientation.grid(grid)
    nodes = turned.nodes[turned.inside]
    (left, bottom), (right, top) = nodes.min(axis=0) - 4, nodes.max(axis=0) + 4
    diffusivity = np.where(grid.inside, np.trace(volume.tensors, axis1=-2, axis2=-1) / 2, np.nan)
    mean, lengths, found = np.nanmedian(diffusivity), np.array([6.0, 9.0, 13.0]), []  # distances that heat travels, mm
    for metric, name, scale, unit in (("tensor", "D", mean, "mm⁴/s"), ("inverse", "D⁻¹", 1 / mean, "s")):
        field, times = hj.TensorField.from_diffusion(grid, volume.tensors, metric), lengths**2 * scale
        pairs = hj.eigenpairs(field, 500, "mean", multiplet="drop")
        values, near = np.asarray(hj.hks(pairs, times, "flat")), np.asarray(hj.boundary_influence(pairs, times)) > 0.1
        far = np.where(near, np.nan, np.abs(values - 1))
        figure = hj.plot.hks_panels(
            values,
            times,
            grid,
            titles=[f"{d:g} mm\n$t$ = {hj.plot.number_text(t)} {unit}" for d, t in zip(lengths, times, strict=True)],
            limits=[(1 - reach, 1 + reach) for reach in np.nanquantile(far, 0.99, axis=(1, 2))],
            cmap="RdBu_r",
            label=rf"$4\pi t$·HKS, metric {name}",
            beside={"mean diffusivity\nin $10^{-3}$ mm²/s": 1e3 * diffusivity},
            hatched=near,
            orientation=orientation,
            length_unit="mm",
            suptitle="The value 1 means flat; hatched: the boundary contributes over 10 %",
        )
        for ax in figure.axes:
            ax.set(xlim=(left, right), ylim=(bottom, top))
        figure.set_size_inches(10, 3.8)
        hj.plot.save_figure(figure, f"paper-figure6-{metric}.png")
        found.append(np.where(near[0], np.nan, values[0]))
    free = np.isfinite(found[0] + found[1])
    return np.corrcoef(found[0][free], found[1][free])[0, 1]


files = hj.io.find_example_brain()
if files is None or importlib.util.find_spec("dipy") is None:
    print('Figure 6 is skipped: it needs the wheel mdt==1.2.7 (pip install --no-deps) and "hks-jax[dti]"')
else:
    relation = draw_brain(files)
    print(f"correlation of the two at the smallest t: {relation:.2f}")
    assert relation < -0.5

# %% [markdown]
# ## The outlook: comparison with smoothed scalars
#
# Trace, determinant and anisotropy can be smoothed by Gaussians (`gaussian_scale_space`), or by heat flow in the
# metric (`heat_flow`), over the distance that heat travels in the time of the signature. Smoothed scalars show where
# a scalar was large, and become constant as t grows. Trace and determinant show the ventricles, and anisotropy shows
# the fibres. Heat flow along fibres gives other shapes. The signature does not become constant in this way. At small
# t it shows the tissue: ventricles are low and the centres of fibres are high. At large t it shows how far every
# point is from the others and from the rim. The comparison uses an analytic phantom of a brain.

# %%
tensors, mask, spacing = phantom((38, 44))
brain = hj.Grid(mask.shape, spacing, mask=mask, components="largest")
deep = hj.io.erode(brain.inside, 4)
mean = float(np.median(np.trace(tensors, axis1=-2, axis2=-1)[brain.inside])) / 2
lengths = np.array([8.0, 16.0, 32.0])  # √(Dt) in mm, the distance that heat travels
field = hj.TensorField.from_diffusion(brain, tensors, "inverse")
scalars = hj.tensor_invariants(hj.TensorField(brain, tensors))
stacked = np.stack(list(scalars.values()))
times = lengths**2 / mean
blurred = hj.gaussian_scale_space(field, times, stacked)
of_heat = heat(brain, field.tensors, jnp.asarray(times), 250, functions=jnp.asarray(stacked))
signatures, diffused = (np.asarray(each) for each in of_heat)
columns = {"4πt·HKS": signatures}
for way, values in (("blurred", blurred), ("diffused", diffused)):
    columns |= {f"{name}, {way}": values[:, i] for i, name in enumerate(scalars)}

figure = hj.plot.new_figure(16, 7)
panels = figure.subplots(len(times), len(columns))
for line, (name, values) in zip(panels.T, columns.items(), strict=True):
    for ax, image in zip(line, values, strict=True):
        hj.plot.scalar_image(ax, image, brain, quantiles=(0.02, 0.9 if "HKS" in name else 1))
        ax.set(xticks=[], yticks=[])
    line[0].set_title(name.replace(", ", ",\n"), fontsize="medium", pad=16)
for ax, length in zip(panels[:, 0], lengths, strict=True):
    ax.set_ylabel(f"√(Dt) = {length:g} mm")
hj.plot.save_figure(figure, "paper-outlook.png")

ranges = {name: [float(np.ptp(v[deep]) / v[deep].mean()) for v in values] for name, values in columns.items()}
for name, spread in ranges.items():
    print(f"{name:22} varies by", "  ".join(f"{s:6.1%}" for s in spread))
assert all(np.all(np.diff(spread) < 0) for name, spread in ranges.items() if "HKS" not in name)
assert np.all(np.diff(ranges["4πt·HKS"]) > 0)
assert min(ranges["4πt·HKS"]) > 0.5

# %% [markdown]
# ### The same surface in other coordinates
#
# We compute on a torus of revolution, and on the same surface in curvilinear coordinates y with x = ψ(y). The surface
# is the same, so the signature at each point does not change. The same holds for a function smoothed by heat flow,
# but not for a function smoothed by a Gaussian. Trace, determinant and anisotropy are scalars of the matrix and not
# of the metric. They differ between coordinates before any smoothing. This example shows the trace.

# %%
n, times = 50, jnp.array([0.4, 1.2])


def psi(y):
    return y + jnp.stack([0.3 * jnp.sin(y[0]) + 0.2 * jnp.sin(y[1]), 0.25 * jnp.cos(y[0] + y[1])])


def pulled_back(y):
    jacobian = jax.jacfwd(psi)(y)
    return jacobian.T @ torus.function(psi(y)) @ jacobian


torus = hj.examples.torus_field((n, n))
bent = hj.TensorField.from_function(pulled_back, torus.grid)
places = np.moveaxis(np.asarray(jax.vmap(jax.vmap(psi))(torus.grid.nodes)), -1, 0) / torus.grid.spacing[0]


def moved(values):  # f(x) -> f(ψ(y)) at the nodes
    return np.stack([map_coordinates(v, places, order=3, mode="grid-wrap") for v in np.asarray(values)])


wave = np.cos(3 * torus.grid.nodes[..., 0])
found = []
for surface, function in ((torus, wave), (bent, moved([wave])[0])):
    functions = np.stack([function, hj.tensor_invariants(surface)["trace"]])
    values, flows = heat(surface.grid, surface.tensors, times, 150, "periodic", jnp.asarray(functions))
    blurs = hj.gaussian_scale_space(surface, times, functions)
    found.append({"4πt·HKS": values, "trace, diffused": flows[:, 1], "trace, blurred": blurs[:, 1]})
    found[-1] |= {"a function, diffused": flows[:, 0], "a function, blurred": blurs[:, 0]}
changes, expected = {}, {name: moved(values) for name, values in found[0].items()}
for name, values in expected.items():
    changes[name] = float(np.linalg.norm(found[1][name] - values) / np.linalg.norm(values - values.mean()))
    print(f"{name:20} differs by {changes[name]:.1%}")
assert max(changes["4πt·HKS"], changes["a function, diffused"]) < 0.05
assert min(changes["trace, diffused"], changes["trace, blurred"], changes["a function, blurred"]) > 0.3

# %% [markdown]
# The upper row is computed in coordinates x and then transformed to y. The lower row is computed in y.

# %%
figure = hj.plot.new_figure(14, 5.4)
for index, (line, values) in enumerate(zip(figure.subplots(2, 5), (expected, found[1]), strict=True)):
    for ax, (name, images) in zip(line, values.items(), strict=True):
        low, high = expected[name][0].min(), expected[name][0].max()
        hj.plot.scalar_image(ax, images[0], torus.grid, vmin=low, vmax=high)
        ax.set(title="" if index else name, xticks=[], yticks=[])
    line[0].set_ylabel("computed in y" if index else "computed in x, moved to y")
drawn = [np.asarray(ax.images[0].get_array()) for ax in figure.axes if ax.images]
assert len(drawn) == 10
assert np.abs(drawn[0] - drawn[5]).max() < 0.1 * np.ptp(drawn[0])
assert np.abs(drawn[1] - drawn[6]).max() > 0.3 * np.ptp(drawn[1])
hj.plot.save_figure(figure, "paper-isometry.png")
