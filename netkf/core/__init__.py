"""The lowest room: errors, checked fields, clocks and CSV files."""
