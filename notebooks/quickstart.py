# %% [markdown]
# # Quick start
#
# This notebook computes the heat kernel signature of a tensor field. The signature shows curvature that the
# invariants of the tensors do not show. The file is a notebook in the percent format: open it in Jupyter (with
# jupytext) or in an editor, or run it as a script.

# %%
import jax
import jax.numpy as jnp
import numpy as np

import hks_jax as hj

jax.config.update("jax_enable_x64", True)

# %% [markdown]
# ## Two fields with the same eigenvalues
#
# Both fields have the eigenvalues 4 and 1 at every point, and therefore the same trace, determinant and anisotropy.
# In one field the major direction is constant; in the other it oscillates. The first field is flat, the second is
# curved.

# %%
fields = hj.examples.figure4_fields(41)
straight, cells = fields["straight"], fields["cells"]
for field in (straight, cells):
    assert np.allclose(np.linalg.eigvalsh(field.tensors), [1, 4])
print("curvature of 'straight':", float(jnp.abs(hj.gaussian_curvature(straight)).max()))
print("curvature of 'cells': ", float(jnp.abs(hj.gaussian_curvature(cells)).max()))

# %% [markdown]
# ## Eigenpairs
#
# `"mirror"` reflects the domain on every side, so that a flat metric shows no boundary effect.

# %%
pairs = {"straight": hj.eigenpairs(straight, 301, "mirror"), "cells": hj.eigenpairs(cells, 300, "mirror")}
print(pairs["cells"].summary())

# %% [markdown]
# ## Signatures
#
# 4πt·HKS is 1 for a flat metric without boundary.

# %%
times = jnp.array([0.03, 0.06, 0.12])
signatures = {name: hj.hks(p, times, "flat") for name, p in pairs.items()}
for name, values in signatures.items():
    spread = np.ptp(np.asarray(values), axis=(1, 2))
    print(f"{name:9s}", "  ".join(f"t={t:.2f}: {s:.4f}" for t, s in zip(times, spread, strict=True)))
assert np.ptp(signatures["cells"][1]) > 10 * np.ptp(signatures["straight"][1])

# %%
figure = hj.plot.hks_panels(signatures["cells"], times, cells.grid)
assert [len(ax.images) for ax in figure.axes] == [1, 1, 1]

# %% [markdown]
# ## What to trust

# %%
report = hj.truncation(pairs["cells"], times)
print("tail beyond k:     ", report.tail)
print("bias of the grid:  ", report.resolution_bias)
assert report.tail.max() < 0.01

# %% [markdown]
# ## Curvature from small times
#
# Inside, 4πt·HKS = 1 + K t/3 + … The remaining difference from this expansion is the bias of the grid, 0.05·h²/t.

# %%
t = 0.01
inner = (slice(12, -12), slice(12, -12))
values = hj.hks(pairs["cells"], [t], "flat")[0][inner]
for order in range(4):
    series = 4 * np.pi * t * hj.hks_expansion(cells, [t], order)[0][inner]
    print(f"expansion to order {order}: largest difference {float(jnp.abs(values - series).max()):.4f}")
assert jnp.abs(values - series).max() < 0.2 * jnp.abs(values - 1).max()
