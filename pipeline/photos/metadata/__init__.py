"""A photo's metadata, from untrusted bytes: EXIF, XMP, sensors, angles, positions."""
