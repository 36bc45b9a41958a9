"""Figures of runs, ensembles and sweeps, all with one look."""
