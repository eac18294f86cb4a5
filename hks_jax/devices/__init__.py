"""Several devices: batches shared out, and space cut into slabs. docs/devices.md says what is exchanged."""

from hks_jax.devices.batch import map_fields as map_fields
from hks_jax.devices.heat import chebyshev_series as chebyshev_series
from hks_jax.devices.heat import heat_columns as heat_columns
from hks_jax.fem.halo import Slabs as Slabs
