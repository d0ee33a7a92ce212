"""Files of control points, positions, boundaries and scale bars as surveyors write them, from untrusted text."""
