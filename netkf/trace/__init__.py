"""What is recorded: schema, recorder, tables, fingerprint, first difference."""
