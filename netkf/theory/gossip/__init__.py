"""Theory of the gossip filter (G)."""
