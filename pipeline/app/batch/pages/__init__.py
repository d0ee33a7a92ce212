"""The state of a batch, and its page for people."""
