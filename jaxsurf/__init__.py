"""Partial differential equations on curved surfaces given as point clouds."""

__version__ = "0.1.0"
