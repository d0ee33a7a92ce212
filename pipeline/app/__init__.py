"""The command line and what it shows: console, report, live view."""
