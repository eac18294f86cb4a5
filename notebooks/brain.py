# %% [markdown]
# # A brain, from the scan to its signature
#
# This notebook starts from diffusion-weighted images with b-values and directions, and fits tensors. Then follow the
# mask, a slice, the metric, the eigenpairs, the heat kernel signature at several times, pictures, and a NIfTI file in
# the space of the scan. To use your own scan, run
#
#     HKS_SCAN=dwi.nii.gz HKS_SLICE=10 python notebooks/brain.py
#
# with `dwi.bval` and `dwi.bvec` beside the scan. Without a scan, the notebook simulates one of a phantom.

# %%
import os
import tempfile
from pathlib import Path

import jax
import nibabel as nib
import numpy as np
from scipy.ndimage import distance_transform_edt

import hks_jax as hj
from hks_jax.cli import main
from hks_jax.domain.examples import phantom

jax.config.update("jax_enable_x64", True)

# %% [markdown]
# ## The scan
#
# In tissue with the tensor D, the signal along the direction u is S₀ exp(−b uᵀDu). Its noise is Rician: the signal is
# the modulus of a complex number with Gaussian noise, here 2 % of S₀. Directions follow FSL's convention. They refer
# to the voxel axes, and the first axis is reversed if the affine's determinant is positive.


# %%
def simulate(folder, noise=0.02):
    """Write a scan of the phantom: 2 images without weighting, 30 with b = 1000 s/mm². Return its path and D."""
    rng = np.random.default_rng(0)
    tensors, mask, spacing = phantom((52, 62, 9))
    u = rng.standard_normal((32, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    b = np.where(np.arange(32) < 2, 0.0, 1000.0)
    signal = np.exp(-b * np.einsum("na,xyzab,nb->xyzn", u, tensors, u)) * np.where(mask, 1.0, 0.01)[..., None]
    normal = noise * rng.standard_normal((2, *signal.shape))
    images = (1000 * np.hypot(signal + normal[0], normal[1])).astype(np.float32)
    nib.save(nib.Nifti1Image(images, np.diag([*spacing, 1.0])), folder / "dwi.nii.gz")
    np.savetxt(folder / "dwi.bval", b[None], fmt="%g")
    np.savetxt(folder / "dwi.bvec", (u * [-1.0, 1.0, 1.0]).T, fmt="%.6f")
    return folder / "dwi.nii.gz", tensors


folder = Path(tempfile.mkdtemp())
scan, truth = (Path(os.environ["HKS_SCAN"]), None) if "HKS_SCAN" in os.environ else simulate(folder)
stem = scan.name.removesuffix(".gz").removesuffix(".nii")
bval, bvec = (scan.with_name(stem + suffix) for suffix in (".bval", ".bvec"))

# %% [markdown]
# ## Tensors
#
# Without a mask, DIPY's `median_otsu` finds the brain. A slice uses the in-plane block of D, so diffusion stays in
# the slice. The rim is removed, because its voxels contain tissue and its surroundings. Noise makes some tensors
# indefinite or nearly singular, and D⁻¹ would not exist or be extremely large. These tensors are replaced by the
# nearest valid tensors.

# %%
volume = hj.io.fit_dwi(scan, bval, bvec, b_max=1500)
index = int(os.environ.get("HKS_SLICE", volume.shape[2] // 2))
plane = volume.slice("z", index)
plane = hj.io.repair_tensors(plane.with_mask(hj.io.erode(plane.mask, 1)), "nearest", 1e-4)
print(volume.shape, "voxels of", np.round(volume.spacing, 2), "mm")
print(*plane.notes, sep="\n")
assert np.linalg.eigvalsh(plane.tensors[plane.mask]).min() > 0.99e-4

# %% [markdown]
# ## Metric, eigenpairs, times
#
# `metric="inverse"` is g = D⁻¹, in which two points are near if diffusion between them is fast, and t is a time. In
# the time t heat spreads over the distance √(Dt). If this distance is at least two voxels, the error of the grid is a
# few per cent. The diffusion of a substance by Fick's law has the same distances but another operator
# (`operator="fick"`, docs/choices.md).

# %%
grid = plane.grid("largest")
field = hj.TensorField.from_diffusion(grid, plane.tensors, metric="inverse")
diffusivity = np.trace(plane.tensors, axis1=-2, axis2=-1) / 2
lengths = max(plane.spacing) * np.array([2.0, 4.0, 8.0, 16.0])
times = lengths**2 / float(np.median(diffusivity[grid.inside]))
pairs = hj.eigenpairs(field, 250)
print(pairs.summary())
signature = np.asarray(hj.hks(pairs, times))
report = hj.truncation(pairs, times)
print("beyond k:", np.round(report.tail, 4), " bias of the grid:", np.round(report.resolution_bias, 4))
assert report.tail.max() < 0.02
assert report.resolution_bias.max() < 0.05

# %% [markdown]
# The total heat is constant. At large t it is uniform with respect to the area of the metric, |D|^(−½) dx, and the
# signature is one over this area of the slice.

# %%
latest = hj.hks(pairs, [40 / float(pairs.eigenvalues[1])])[0]
assert np.allclose(latest[grid.inside & np.isfinite(signature[0])], 1 / float(pairs.pencil.volume))

# %% [markdown]
# ## Pictures
#
# The first figure shows the mean diffusivity and the ellipses of D, coloured by direction.

# %%
figure = hj.plot.new_figure(11, 5.6)
left, right = figure.subplots(1, 2)
inside = grid.nodes[grid.inside]
window = dict(zip(("xlim", "ylim"), zip(inside.min(axis=0) - 6, inside.max(axis=0) + 6, strict=True), strict=True))
hj.plot.scalar_image(left, diffusivity, grid, cmap="gray", quantiles=(0.01, 0.97), label="mean diffusivity, mm²/s")
hj.plot.ellipses(right, field, every=2, sizes="fit", color="orientation")
for ax in (left, right):
    ax.set(xlabel="mm", **window)
hj.plot.save_figure(figure, "brain-tensors.png")

# %% [markdown]
# The second figure shows the signature. The rim is a natural boundary and raises the signature up to fourfold. The
# colours span the values inside; arrows at the colour bars mark larger values. At small times the signature shows
# tissue: ventricles are low, because heat leaves them quickly. At large times it shows points that are far from all
# others.

# %%
depth = distance_transform_edt(np.pad(grid.inside, 1), sampling=grid.spacing)[1:-1, 1:-1]
deep = depth > min(2 * lengths[0], 0.4 * depth.max())
figure = hj.plot.new_figure(13, 3.8)
for ax, values, t, length in zip(figure.subplots(1, 4), signature, times, lengths, strict=True):
    low, high = np.quantile(values[depth > min(2 * length, 0.4 * depth.max())], (0.01, 0.99))
    hj.plot.scalar_image(ax, values, grid, vmin=float(low), vmax=float(high))
    ax.set_title(f"$t$ = {hj.plot.number_text(t)} s\n√(Dt) = {length:.3g} mm", fontsize="medium")
    ax.set(**window)
    ax.set_axis_off()
drawn = [ax.images[0].get_array() for ax in figure.axes if ax.images]
assert all(np.array_equal(image.T.compressed(), v[np.isfinite(v)]) for image, v in zip(drawn, signature, strict=True))
hj.plot.save_figure(figure, "brain-hks.png")
high = np.quantile(diffusivity[deep], 0.96)
fluid, tissue = deep & (diffusivity > high), deep & (diffusivity < np.median(diffusivity[deep]))
ratios = [float(np.median(values[fluid]) / np.median(values[tissue])) for values in signature]
print("signature of the fluid over that of tissue:", np.round(ratios, 2))
assert ratios[0] < 0.9

# %% [markdown]
# ## The effect of noise
#
# For a phantom, the true tensors are given. The signature averages over the region that heat reaches. Its relative
# error is therefore a fraction of the relative error of the tensors.

# %%
if truth is not None:
    flat = truth[:, :, index, :2, :2]
    exact = np.asarray(hj.hks(hj.eigenpairs(hj.TensorField.from_diffusion(grid, flat, "inverse"), 250), times))
    of_tensors = np.linalg.norm(plane.tensors - flat, axis=(-2, -1)) / np.linalg.norm(flat, axis=(-2, -1))
    errors = [float(np.median(np.abs(a - b)[deep] / b[deep])) for a, b in zip(signature, exact, strict=True)]
    print(
        f"median error of the tensors {np.median(of_tensors[deep]):.1%}, of the signature", [f"{e:.1%}" for e in errors]
    )
    assert max(errors) < 0.5 * np.median(of_tensors[deep])

# %% [markdown]
# ## Files, and the same result from the command line
#
# The NIfTI file has the times along its fourth axis. Its affine gives the position of the slice in the scan.

# %%
image = nib.load(hj.io.save(folder / "hks.nii.gz", signature, plane, name="hks"))
assert image.shape == (*grid.shape, 1, 4)
assert np.allclose(image.affine @ [0, 0, 0, 1], nib.load(scan).affine @ [0, 0, index, 1], atol=1e-3)
command = (
    f"hks {scan} --bval {bval} --bvec {bvec} -o {folder / 'out'} --slice z={index} --erode 1 --repair nearest:1e-4"
)
command += f" --b-max 1500 --metric inverse --components largest -k 250 --times {' '.join(map(str, times))}"
command += " --boundary neumann --normalisation raw --quiet"
print("hks-jax", command)
assert main(command.split()) == 0
with np.load(folder / "out" / "hks.npz") as result:
    assert np.allclose(result["hks"], signature, rtol=1e-6, equal_nan=True)
