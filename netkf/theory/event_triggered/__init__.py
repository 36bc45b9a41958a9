"""Theory of event-triggered consensus on information: its assumptions."""
