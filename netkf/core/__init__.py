"""Shared words: types, errors, settings, random streams, small matrix helpers."""
