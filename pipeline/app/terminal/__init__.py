"""The terminal, shared by all commands: parameters, preparation, progress, summary and exit code."""
