"""Inverse problems: unknowns of a model from noisy data."""
