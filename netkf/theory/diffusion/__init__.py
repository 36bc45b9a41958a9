"""Theory of the diffusion filter (D)."""
