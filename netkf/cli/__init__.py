"""The command line: the parser, shared options, and one module for each command."""
