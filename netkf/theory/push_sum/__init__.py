"""Theory of the push-sum filter (P)."""
