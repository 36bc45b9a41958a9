"""Theory of the hybrid filter (H): the bound H(12) over time, its steady state and its limits."""
