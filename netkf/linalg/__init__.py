"""Matrices: small kernels, series, and the decorator that compiles them."""
