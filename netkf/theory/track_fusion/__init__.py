"""Theory of track fusion: exact errors, and the assumptions under which P bounds them."""
