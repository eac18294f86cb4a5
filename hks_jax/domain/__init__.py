"""Domains: grids, tensor fields and meshes."""
