"""Scenes larger than one fit: cut into blocks that share one photometry, fitted apart, merged."""
