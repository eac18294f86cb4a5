"""Linear solves on the complement of computed eigenvectors, for derivatives."""
