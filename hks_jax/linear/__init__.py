"""Linear algebra of symmetric matrices, independent of domains and meshes."""
