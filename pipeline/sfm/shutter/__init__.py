"""A film's rolling shutter: the camera's motion, the readout time, and keypoints as if rows were exposed together."""
