"""Stencils: kernels, monomials, the batched moment solves, and the two methods built on them."""
