"""Numerics on plain matrices: checked inputs, algebraic equations, predictions, updates."""
