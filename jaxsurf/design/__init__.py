"""Shapes as unknowns: families with parameters, functionals, verified derivatives."""
