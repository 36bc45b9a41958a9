"""Logs of instruments and data sets that people know, as folders with a scenario and its tables."""
