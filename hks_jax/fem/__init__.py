"""From domains to matrices: elements, boundaries, assembly, operators."""
