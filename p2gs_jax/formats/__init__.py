"""Files that other programs know."""
