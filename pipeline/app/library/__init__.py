"""splatpipe as a library: what ``import splatpipe`` offers, and what the command line is built on."""
