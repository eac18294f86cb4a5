"""A single-file page to explore signatures in a browser, without a server, a network or other libraries."""

from hks_jax.plot.explore.page import explore as explore
