"""Stencils: kernels, monomials, the batched moment solves, and the methods built on them."""
