"""Checks of what a scenario says about its own parts: clocks, channels, matchings and noises."""
