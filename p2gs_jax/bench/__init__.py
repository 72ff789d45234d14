"""Benches: speed against error, measured in one process."""
