"""Exact error covariances along the events of a run, and helpers that the papers share."""
