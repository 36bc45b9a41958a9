"""Theory of the gossip filter (G): assumptions, mean matchings, detecting walks, exact errors."""
