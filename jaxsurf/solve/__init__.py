"""Steady problems, eigenmodes and what is made of them."""
