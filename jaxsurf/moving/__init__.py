"""Surfaces that move, and equations on them."""
