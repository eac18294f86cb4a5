"""Heat kernel signatures without eigenpairs: exp(−tM⁻¹K)M⁻¹ by polynomials and by rational functions."""
