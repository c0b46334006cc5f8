"""Borders of surfaces: which points lie on one, their order along it, outward conormals."""
