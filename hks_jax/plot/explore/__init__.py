"""A page to explore signatures in a browser: one file, without a server, a network or another library."""

from hks_jax.plot.explore.page import explore as explore
