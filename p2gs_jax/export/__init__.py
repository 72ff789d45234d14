"""Files that a run writes and that other programs read."""
