"""Figures of tensor fields and their heat kernel signatures with matplotlib's object-oriented interface.

Every function draws on given axes, so figures can be combined, such as integral lines over an image of the HKS. No
function uses pyplot or changes a backend or rcParams.
"""

from hks_jax.plot.convolution import lic_texture as lic_texture
from hks_jax.plot.convolution import line_integral_convolution as line_integral_convolution
from hks_jax.plot.curves import hks_curves as hks_curves
from hks_jax.plot.curves import spectrum as spectrum
from hks_jax.plot.explore import explore as explore
from hks_jax.plot.figure import new_figure as new_figure
from hks_jax.plot.figure import number_text as number_text
from hks_jax.plot.figure import save_figure as save_figure
from hks_jax.plot.fit import fit_panels as fit_panels
from hks_jax.plot.glyphs import degenerate_points as degenerate_points
from hks_jax.plot.glyphs import ellipses as ellipses
from hks_jax.plot.glyphs import sensitivity as sensitivity
from hks_jax.plot.images import influence_map as influence_map
from hks_jax.plot.images import scalar_image as scalar_image
from hks_jax.plot.orientation import Orientation as Orientation
from hks_jax.plot.panels import hks_panels as hks_panels
from hks_jax.plot.panels import time_rows as time_rows
from hks_jax.plot.signature import signature_panels as signature_panels
from hks_jax.plot.surfaces import isosurfaces as isosurfaces
from hks_jax.plot.surfaces import surface as surface
from hks_jax.plot.tracing import evenly_spaced_lines as evenly_spaced_lines
from hks_jax.plot.tracing import integral_lines as integral_lines
from hks_jax.plot.tracing import trace as trace
from hks_jax.plot.volumes import middle_node as middle_node
from hks_jax.plot.volumes import orthogonal_slices as orthogonal_slices
from hks_jax.plot.volumes import volume_panels as volume_panels
