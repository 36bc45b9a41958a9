"""Runs and what is made of them: directories, tables, verdicts, pictures."""
