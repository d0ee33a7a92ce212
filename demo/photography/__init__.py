"""How it is photographed: flight and lens, path tracing, the sensor, metadata and the survey."""
