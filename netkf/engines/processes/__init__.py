"""The reference engine: SimPy. Every `yield` of a simulated process is in this folder."""
