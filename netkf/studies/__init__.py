"""Many scenarios: sweeps over keys, sizing for a target, finished runs side by side."""
