"""Theory of the hybrid filter (H): the bound (12), its steady state and limits."""
