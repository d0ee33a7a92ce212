"""What a report says of a run, read from its artifacts and log, and in which words."""
