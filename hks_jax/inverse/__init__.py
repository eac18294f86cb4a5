"""Inverse problems: fits of metrics to signatures."""

from hks_jax.inverse.fit import fit_metric as fit_metric
from hks_jax.inverse.gauss_newton import GaussNewton as GaussNewton
from hks_jax.inverse.identifiability import Identifiability as Identifiability
from hks_jax.inverse.identifiability import identifiability as identifiability
from hks_jax.inverse.metric_fit import MetricFit as MetricFit
from hks_jax.inverse.metric_fit import Posterior as Posterior
from hks_jax.inverse.metric_fit import Step as Step
from hks_jax.inverse.observation import Data as Data
from hks_jax.inverse.regulariser import H1 as H1
from hks_jax.inverse.regulariser import LogDeterminant as LogDeterminant
from hks_jax.inverse.regulariser import Prior as Prior
from hks_jax.inverse.regulariser import Regulariser as Regulariser
from hks_jax.inverse.regulariser import TotalVariation as TotalVariation
from hks_jax.inverse.search import Search as Search
from hks_jax.inverse.signature import Signature as Signature
from hks_jax.inverse.signature import wave_kernel as wave_kernel
from hks_jax.inverse.unknowns import Free as Free
from hks_jax.inverse.unknowns import Parametrisation as Parametrisation
