"""Theory of the diffusion filter (D): assumptions, the information condition, exact errors."""
