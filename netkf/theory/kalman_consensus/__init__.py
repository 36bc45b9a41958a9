"""Theory of the Kalman-consensus filter: exact errors."""
