"""Theory of belief propagation: exact errors, and the assumptions under which P is right."""
