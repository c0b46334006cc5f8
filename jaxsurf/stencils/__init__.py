"""Stencils: what they differentiate, the methods, and the operators made of their weights."""
