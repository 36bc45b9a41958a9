"""Names of figures and formats of their files, for whom matplotlib is not imported yet."""

FORMATS = ("png", "svg", "pdf")
"""Formats of picture files, which are their suffixes."""
FIGURE_NAMES = (
    *("overview", "error", "quantiles", "ratios", "network", "plane", "nees", "nis", "whiteness"),
    *("age", "links", "stability", "law", "delivery", "matrix", "fate", "losses"),
)
"""The figures of runs and ensembles; a sweep has ``stability`` only."""
FIT_FIGURES = ("envelope",)
"""The figures of a fit."""
FIT_FILE = "fit_envelope.csv"
"""The file of a fit that is drawn."""
