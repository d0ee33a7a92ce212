"""What our HTTP servers (``view``, ``node``) have in common: connections, files by range, refused requests."""
