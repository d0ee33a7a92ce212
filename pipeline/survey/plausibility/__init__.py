"""What positions, headings, barometers and control say against each other."""
