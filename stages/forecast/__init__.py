"""Forecast of what each stage takes, before it runs: ``sizes`` of a run, ``costs`` per size, ``needs`` of a stage."""
