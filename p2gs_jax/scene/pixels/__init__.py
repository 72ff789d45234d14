"""Decoded photographs in any number: in memory if all fit, otherwise in mapped files."""
