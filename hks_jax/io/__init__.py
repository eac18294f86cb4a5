"""Read and write files of tensors, masks, meshes and results; fit tensors to diffusion-weighted images."""

from hks_jax.io.dwi import ExampleBrain as ExampleBrain
from hks_jax.io.dwi import find_example_brain as find_example_brain
from hks_jax.io.dwi import fit_dwi as fit_dwi
from hks_jax.io.files import read_tensors as read_tensors
from hks_jax.io.files import save as save
from hks_jax.io.files import save_tensors as save_tensors
from hks_jax.io.maps import read_maps as read_maps
from hks_jax.io.masks import erode as erode
from hks_jax.io.masks import read_mask as read_mask
from hks_jax.io.mesh import read_mesh as read_mesh
from hks_jax.io.mesh import read_mesh_arrays as read_mesh_arrays
from hks_jax.io.pairs import load_pairs as load_pairs
from hks_jax.io.pairs import save_pairs as save_pairs
from hks_jax.io.plausibility import questions as questions
from hks_jax.io.repair import REPAIRS as REPAIRS
from hks_jax.io.repair import find_background as find_background
from hks_jax.io.repair import find_invalid as find_invalid
from hks_jax.io.repair import positive_tensors as positive_tensors
from hks_jax.io.repair import repair_tensors as repair_tensors
from hks_jax.io.result import Result as Result
from hks_jax.io.sampling import sample_tensors as sample_tensors
from hks_jax.io.tensor_order import ORDERS as ORDERS
from hks_jax.io.units import UNITS as UNITS
from hks_jax.io.volume import TensorVolume as TensorVolume
from hks_jax.storage import atomic_folder as atomic_folder
from hks_jax.storage import atomic_path as atomic_path
