"""Topology, clocks and channels: who talks when, and what becomes of a message."""
