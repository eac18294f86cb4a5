"""hks_jax: differentiable spectral geometry of symmetric positive definite tensor fields.

The steps from tensors to a signature are:

    grid = Grid(shape=(nx, ny), spacing=(hx, hy))
    field = TensorField(grid, tensors)
    pairs = eigenpairs(field, k=200)
    signature = hks(pairs, default_times(pairs, 8))

The examples in all docstrings begin with these lines:

    >>> import pathlib, tempfile
    >>> import jax, jax.numpy as jnp, numpy as np
    >>> import hks_jax as hj
    >>> field = hj.examples.figure4_fields(9)["circles"]  # a flat metric of area 2 on the unit square
    >>> pairs = hj.eigenpairs(field, k=12)
    >>> folder = pathlib.Path(tempfile.mkdtemp())
"""

import importlib
from typing import Any

from hks_jax.accuracy import AccuracyWarning as AccuracyWarning
from hks_jax.cache import keep_compiled as keep_compiled
from hks_jax.compilation import compiler_options as compiler_options
from hks_jax.curvature import gaussian_curvature as gaussian_curvature
from hks_jax.curvature import hks_expansion as hks_expansion
from hks_jax.curvature import laplace_beltrami as laplace_beltrami
from hks_jax.curvature import scalar_curvature as scalar_curvature
from hks_jax.domain.degenerate import DegeneratePoints as DegeneratePoints
from hks_jax.domain.degenerate import degenerate_points as degenerate_points
from hks_jax.domain.grid import Grid as Grid
from hks_jax.domain.simplicial_mesh import SurfaceMesh as SurfaceMesh
from hks_jax.domain.simplicial_mesh import TetMesh as TetMesh
from hks_jax.domain.tensor_field import TensorField as TensorField
from hks_jax.eigen.adjoints.complement import Adjoint as Adjoint
from hks_jax.eigen.adjoints.factorised_adjoint import FactorisedAdjoint as FactorisedAdjoint
from hks_jax.eigen.driver import eigenpairs as eigenpairs
from hks_jax.eigen.driver import eigsh as eigsh
from hks_jax.eigen.eigenpairs import RESULTS as RESULTS
from hks_jax.eigen.eigenpairs import Eigenpairs as Eigenpairs
from hks_jax.eigen.filter.chebyshev_filter import ChebyshevFilter as ChebyshevFilter
from hks_jax.eigen.filter.filtered_adjoint import FilteredAdjoint as FilteredAdjoint
from hks_jax.eigen.inertia import count_eigenvalues as count_eigenvalues
from hks_jax.eigen.lanczos.block_lanczos import BlockLanczos as BlockLanczos
from hks_jax.eigen.shift_invert.host_adjoint import HostAdjoint as HostAdjoint
from hks_jax.eigen.shift_invert.shift_invert import ShiftInvert as ShiftInvert
from hks_jax.eigen.solver import Dense as Dense
from hks_jax.eigen.solver import Eigensolver as Eigensolver
from hks_jax.eigen.weyl import weyl_count as weyl_count
from hks_jax.fem.assembly import assemble as assemble
from hks_jax.fem.assembly import assemble_forms as assemble_forms
from hks_jax.fem.boundary import crop as crop
from hks_jax.fem.boundary import default_boundary as default_boundary
from hks_jax.fem.boundary import reflect as reflect
from hks_jax.fem.pencil import MirrorPencil as MirrorPencil
from hks_jax.fem.pencil import Pencil as Pencil
from hks_jax.fem.sparse_input import sparse_pencil as sparse_pencil
from hks_jax.linear.dense_eigh import DenseEigenpairs as DenseEigenpairs
from hks_jax.linear.dense_eigh import eigh as eigh
from hks_jax.linear.factorised_matrix import FactorisedMatrix as FactorisedMatrix
from hks_jax.linear.matrix_function import matrix_function as matrix_function
from hks_jax.linear.symmetric_pencil import SymmetricPencil as SymmetricPencil
from hks_jax.signatures.alignment import Alignment as Alignment
from hks_jax.signatures.alignment import align as align
from hks_jax.signatures.distances import biharmonic_distance as biharmonic_distance
from hks_jax.signatures.distances import diffusion_distance as diffusion_distance
from hks_jax.signatures.distances import global_point_signature as global_point_signature
from hks_jax.signatures.distances import shape_dna as shape_dna
from hks_jax.signatures.distances import varadhan_distance as varadhan_distance
from hks_jax.signatures.flow import gaussian_scale_space as gaussian_scale_space
from hks_jax.signatures.flow import heat_flow as heat_flow
from hks_jax.signatures.flow import tensor_invariants as tensor_invariants
from hks_jax.signatures.hks import hks as hks
from hks_jax.signatures.hks_auto import AutomaticHKS as AutomaticHKS
from hks_jax.signatures.hks_auto import hks_auto as hks_auto
from hks_jax.signatures.kernels import heat_kernel as heat_kernel
from hks_jax.signatures.kernels import heat_trace as heat_trace
from hks_jax.signatures.kernels import scale_invariant_hks as scale_invariant_hks
from hks_jax.signatures.kernels import spectral_signature as spectral_signature
from hks_jax.signatures.kernels import wks as wks
from hks_jax.signatures.log_determinant import LogDeterminant as LogDeterminant
from hks_jax.signatures.log_determinant import heat_coefficients as heat_coefficients
from hks_jax.signatures.log_determinant import log_determinant as log_determinant
from hks_jax.signatures.modes import ModeEnergies as ModeEnergies
from hks_jax.signatures.modes import decompose as decompose
from hks_jax.signatures.modes import energy as energy
from hks_jax.signatures.modes import reconstruct as reconstruct
from hks_jax.signatures.modes import spectral_filter as spectral_filter
from hks_jax.signatures.regions import RegionStatistics as RegionStatistics
from hks_jax.signatures.regions import region_statistics as region_statistics
from hks_jax.signatures.rim import boundary_influence as boundary_influence
from hks_jax.signatures.spans import default_times as default_times
from hks_jax.signatures.surrogates import surrogates as surrogates
from hks_jax.signatures.times import default_energies as default_energies
from hks_jax.signatures.truncation import Truncation as Truncation
from hks_jax.signatures.truncation import truncation as truncation
from hks_jax.signatures.truncation import truncation_map as truncation_map
from hks_jax.spectrum_free.colouring import Colouring as Colouring
from hks_jax.spectrum_free.heat_diagonal import colouring as colouring
from hks_jax.spectrum_free.heat_diagonal import hks_spectrum_free as hks_spectrum_free
from hks_jax.spectrum_free.smoothing import smooth as smooth
from hks_jax.uncertainty import TensorNoise as TensorNoise
from hks_jax.uncertainty import Uncertainty as Uncertainty
from hks_jax.uncertainty import smooth_tensors as smooth_tensors
from hks_jax.uncertainty import uncertainty as uncertainty

__version__ = "0.2.0"


_LATER = dict.fromkeys(("fit_metric", "identifiability"), "hks_jax.inverse") | dict.fromkeys(
    ("factorise", "Multifrontal", "SparseLinearOperator"), "hks_jax.fem.factorise"
)


def __getattr__(name: str) -> Any:
    # The modules for several devices, fits, files and figures are imported on first use, because their import is slow.
    if name in ("devices", "inverse", "io", "plot"):
        return importlib.import_module(f"hks_jax.{name}")
    if name in _LATER:
        return getattr(importlib.import_module(_LATER[name]), name)
    if name == "examples":
        return importlib.import_module("hks_jax.domain.examples")
    raise AttributeError(f"module 'hks_jax' has no attribute {name!r}")
