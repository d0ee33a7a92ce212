"""The page at ``/``: captures are handed in, checked and started in the browser, and results are opened there."""
