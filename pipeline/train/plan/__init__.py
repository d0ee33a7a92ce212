"""The plan of a training: lengths, rates, order of photos, sizes, and the limits that it keeps."""
