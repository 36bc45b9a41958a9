"""Exact covariances along the events of a run, and requirements that functions share."""
