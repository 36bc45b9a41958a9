"""Theory of the stochastic event trigger: exact errors, rates and assumptions."""
