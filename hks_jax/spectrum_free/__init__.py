"""Heat kernel signatures without eigenpairs, by polynomial and rational approximations of exp(−tM⁻¹K)M⁻¹."""
