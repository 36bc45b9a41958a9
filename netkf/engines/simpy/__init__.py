"""The definition of what a scenario means, as SimPy processes. Every `yield` is in this folder."""
