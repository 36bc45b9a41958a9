"""The fast engine: numba, an optional extra; same events, same states."""
