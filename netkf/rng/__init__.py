"""Random streams, one for each purpose and entity, and draws from many of them."""
