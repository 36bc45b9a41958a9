"""Whether what is recorded of a run is all of it, once and in order, in memory and in files."""
