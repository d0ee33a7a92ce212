"""Photos on their way to the device: decoding, caching and upload."""
