"""Curvature of a metric, the Laplace–Beltrami operator, and the short-time expansion of the heat kernel."""

from hks_jax.curvature.expansion import hks_expansion as hks_expansion
from hks_jax.curvature.geometry import gaussian_curvature as gaussian_curvature
from hks_jax.curvature.geometry import laplace_beltrami as laplace_beltrami
from hks_jax.curvature.geometry import scalar_curvature as scalar_curvature
