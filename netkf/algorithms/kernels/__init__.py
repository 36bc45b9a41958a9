"""The formulas of the filters: one compiled kernel each."""
