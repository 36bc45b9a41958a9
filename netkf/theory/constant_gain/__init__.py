"""Theory of the filter with constant gains (H Remark 1): exact errors."""
