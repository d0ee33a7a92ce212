"""Whether a reconstruction is right: pairs that contradict it, doubles, and evidence beyond the matches."""
