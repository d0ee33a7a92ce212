"""The command line and its output: console, report, live view."""
