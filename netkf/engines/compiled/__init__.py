"""The compiled engine: the events and states of the SimPy engine, from loops compiled by numba."""
