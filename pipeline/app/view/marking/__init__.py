"""The page for marking control points: the session, what it estimates, and its routes."""
