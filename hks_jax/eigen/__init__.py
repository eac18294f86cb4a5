"""From matrices to eigenpairs: solvers behind one interface, and the report on what they found."""
