"""Error bars: propagate the noise of measured tensors to functions of the tensors."""

from hks_jax.uncertainty.noise import TensorNoise as TensorNoise
from hks_jax.uncertainty.propagate import uncertainty as uncertainty
from hks_jax.uncertainty.result import Uncertainty as Uncertainty
from hks_jax.uncertainty.smoothing import smooth_tensors as smooth_tensors
