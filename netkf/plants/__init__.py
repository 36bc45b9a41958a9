"""How the state moves and is sensed; the truth of one run."""
