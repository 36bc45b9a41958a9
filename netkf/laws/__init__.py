"""Tests of draws against the laws that parts of a scenario state."""
