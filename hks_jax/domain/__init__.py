"""What we compute on: grids, tensor fields, surface meshes."""
