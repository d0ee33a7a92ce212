"""Charts and pictures of a report, as SVG and embedded images."""
