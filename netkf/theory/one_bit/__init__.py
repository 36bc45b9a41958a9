"""Theory of the sign-of-innovations filter: its covariances along the bits of a run."""
