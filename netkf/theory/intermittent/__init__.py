"""Theory of filters with intermittent observations (R): the random Riccati equation and its law."""
