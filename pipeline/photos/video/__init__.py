"""Photos from a film: its container, its subtitles, its motion, and the frames that are chosen."""
