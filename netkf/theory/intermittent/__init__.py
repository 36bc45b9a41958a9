"""Theory of intermittent observations (R): the random Riccati equation."""
