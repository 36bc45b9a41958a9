"""One self-contained HTML page of a run, an ensemble, a sweep or a verdict."""
