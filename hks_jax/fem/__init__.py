"""Assembly of matrices on domains: elements, boundary conditions, weak forms and operators."""
