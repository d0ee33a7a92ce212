"""More photos into a reconstruction that lacks some: stronger keypoints, further pairs, joins; else the reasons."""
