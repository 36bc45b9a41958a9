"""Node algorithms: pure numerics. No time source, no randomness, no network, no SimPy."""
