"""Benches: speed, and the error it is bought with, measured in one process."""
