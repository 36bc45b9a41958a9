"""Theory of consensus plus innovations: exact errors and assumptions."""
