"""Local fits: monomials, kernels, small systems and moments over the neighbourhoods of points."""
